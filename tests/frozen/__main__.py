"""`python -m tests.frozen make`: write what users hold; `check`: compare this tree with it. See README.md here."""

from __future__ import annotations

import argparse
import gzip
import json
import re
import sys
import tempfile
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any

from tests.frozen import commands, routes
from tests.frozen.answers import WEAK, differences
from tests.frozen.records import RECORDS

HERE = Path(__file__).parent
PARTS: dict[str, Callable[[Path], Any]] = {
    **{f"fitted/{name}": partial(commands.of_record, name) for name in RECORDS},
    "without_record": commands.without_record,
    "routes": routes.of_day,
    **{f"diagnosed/{name}": partial(commands.diagnosed, name) for name in RECORDS if name not in WEAK.split("|")},
}
"""What is frozen, each part in a file of its own."""


def made(part: str) -> Any:
    """The part as this tree gives it."""
    with tempfile.TemporaryDirectory(prefix="frozen-") as folder:
        return json.loads(json.dumps(PARTS[part](Path(folder).resolve()), sort_keys=True))


def read(part: str, kept: Path) -> Any:
    """The part as it was kept."""
    return json.loads(gzip.decompress((kept / f"{part}.json.gz").read_bytes()))


def found(part: str, kept: Path) -> tuple[list[str], int]:
    """A line for each difference that nobody meant, and how many were meant (changed.toml)."""
    meant = tomllib.loads((HERE / "changed.toml").read_text("utf-8")).get("changed", [])
    lines, known = [], 0
    for place, words in differences(read(part, kept), made(part), part):
        if any(re.search(one["place"], place) for one in meant):
            known += 1
        else:
            lines.append(f"{place}: {words}")
    return lines, known


def main(arguments: list[str] | None = None) -> int:
    """The exit code: 1 if anything differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.frozen", description=__doc__)
    parser.add_argument("what", choices=["make", "check"])
    parser.add_argument("--only", default="", metavar="PATTERN", help="parts whose name fits")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--kept", type=Path, default=HERE / "kept")
    parser.add_argument("--most", type=int, default=12, help="lines for a part")
    asked = parser.parse_args(arguments)
    parts = [part for part in PARTS if re.search(asked.only, part)]
    if asked.what == "check":
        parts = [part for part in parts if (asked.kept / f"{part}.json.gz").exists()]
    bad = 0
    with ThreadPoolExecutor(asked.jobs) as pool:
        doing = made if asked.what == "make" else partial(found, kept=asked.kept)
        running = {pool.submit(doing, part): part for part in parts}
        for k, done in enumerate(as_completed(running), 1):
            part, result = running[done], done.result()
            words = "made"
            if asked.what == "make":
                text = json.dumps(result, ensure_ascii=False, sort_keys=True).encode()
                path = asked.kept / f"{part}.json.gz"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(gzip.compress(text, 9, mtime=0))
            else:
                lines, known = result
                bad += len(lines)
                words = (f"{len(lines)} differences" if lines else "equal") + (f", {known} meant" if known else "")
                words = "\n    ".join([words, *lines[: asked.most]])
            print(f"{k} of {len(parts)}: {part}: {words}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())

"""The parts of what is frozen, each in a file of its own: made, kept, and compared with what was kept."""

from __future__ import annotations

import gzip
import json
import re
import tempfile
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from tests.frozen import commands
from tests.frozen.answers import differences
from tests.frozen.records import DIAGNOSED, FITTED

HERE = Path(__file__).parent
PARTS: dict[str, Callable[[Path], Any]] = {
    **{f"fitted/{name}": partial(commands.of_record, name) for name in FITTED},
    "without_record": commands.without_record,
    "rest": commands.rest,
    **{f"diagnosed/{name}": partial(commands.diagnosed, name) for name in DIAGNOSED},
}


def made(part: str) -> Any:
    """The part as this tree gives it."""
    with tempfile.TemporaryDirectory(prefix="frozen-") as folder:
        return json.loads(json.dumps(PARTS[part](Path(folder).resolve()), sort_keys=True))


def path_of(part: str) -> Path:
    """Where it is kept."""
    return HERE / "kept" / f"{part}.json.gz"


def keep(part: str) -> tuple[list[str], str]:
    """Write the part as this tree gives it."""
    text = json.dumps(made(part), ensure_ascii=False, sort_keys=True).encode()
    path_of(part).parent.mkdir(parents=True, exist_ok=True)
    path_of(part).write_bytes(gzip.compress(text, 9, mtime=0))
    return [], "made"


def compare(part: str) -> tuple[list[str], str]:
    """A line for each difference that nobody meant; and how many there are, those that are meant (changed.toml) too."""
    meant = tomllib.loads((HERE / "changed.toml").read_text("utf-8")).get("changed", [])
    kept = json.loads(gzip.decompress(path_of(part).read_bytes()))
    lines, known = [], 0
    for place, words in differences(kept, made(part), part):
        if any(re.search(one["place"], place) for one in meant):
            known += 1
        else:
            lines.append(f"{place}: {words}")
    return lines, (f"{len(lines)} differences" if lines else "equal") + (f", {known} meant" if known else "")

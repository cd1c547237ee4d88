"""Helpers of the benches: options, seeds in processes, tables, services with their clients, and provenance lines."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
"""Folder of the measured figures."""
TOKEN = "administrator-token-of-the-bench"


def commit() -> str:
    """Short hash of the tree, with `-dirty` where files differ from it; "not known" outside a git checkout."""
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "not known"


def written_by(command: str) -> str:
    """The first sentence of a results file: command, date (UTC) and commit."""
    return f"Written by `{command}` on {datetime.now(UTC):%Y-%m-%d}, commit {commit()}. Do not edit."


def bench_parser(doc: str | None, seeds: str = "", name: str = "--seeds") -> argparse.ArgumentParser:
    """Make a bench's parser, to which it adds its own options; with `seeds`, it takes a range of them and `--json`."""
    called = f"python -m bench.{Path(sys.argv[0]).stem}"
    parser = argparse.ArgumentParser(prog=called, description=(doc or "").partition("\n")[0])
    if seeds:
        parser.add_argument(name, type=seed_range, default=seeds, help="first:last, last not included")
        parser.add_argument("--json", type=Path, help="write every row here")
    return parser


def seed_range(text: str) -> range:
    """Parse `first:last`, or one seed alone."""
    first, _, last = text.partition(":")
    return range(int(first), int(last or int(first) + 1))


def in_processes(work: Callable[[Any], Any], jobs: Iterable[Any], workers: int | None = 2) -> Iterator[Any]:
    """Do each job in a process of a pool and yield the results in the order of the jobs."""
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(work, jobs)


def write_json(path: Path | None, rows: Any, indent: int | None = 1) -> None:
    """Write rows as JSON, unless `path` is None."""
    if path is not None:
        path.write_text(json.dumps(rows, indent=indent, default=float))


def write_json_lines(path: Path | None, rows: Iterable[Any]) -> None:
    """Write rows as JSON, one a line, unless `path` is None."""
    if path is not None:
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def table(heads: Sequence[str], rows: Iterable[Iterable[object]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [line(heads), "|---" * len(heads) + "|", *map(line, rows)]


def line(cells: Iterable[object]) -> str:
    """Return one line of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


@contextmanager
def services(*emulator: str) -> Iterator[Any]:
    """A service with its emulated rig, and its client."""
    from stimrig.api.cli.supervisor import Services
    from stimrig.api.client.rest import Client
    from stimrig.api.settings import Settings

    with TemporaryDirectory(prefix="stimrig-bench-") as folder:
        settings = Settings(data_dir=Path(folder), port=0)
        with Services(settings, list(emulator), TOKEN) as running, Client(running.url, TOKEN, timeout_s=600) as client:
            yield running, client


def reveal(seed: int, *more: str) -> dict[str, Any]:
    """Return the emulator's hidden truth, read after the verdict; `more` are its options that change that truth."""
    command = [sys.executable, "-m", "stimrig.hardware_sim", "--reveal", str(seed), *more]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout)


def pyplot() -> Any:
    """matplotlib that draws the same SVG each time."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "stimrig", "font.size": 9, "svg.fonttype": "none"})
    import matplotlib.pyplot as plt

    return plt

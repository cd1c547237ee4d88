"""Faults that are planted in a copy of the tree: `bench.planted` looks which part of the suite finds them."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path
from typing import Any

FAULTS = Path(__file__).parents[1] / "planted_faults.toml"
LEFT_BEHIND = (".git", ".venv*", "build", "__pycache__")


def read_faults() -> list[dict[str, Any]]:
    return tomllib.loads(FAULTS.read_text("utf-8"))["fault"]


def copy_tree(source: Path, tree: Path) -> None:
    """A tree whose packages are those it holds: `stimrig/rig` is a link, as it is in the source."""
    shutil.copytree(source, tree, symlinks=True, ignore=shutil.ignore_patterns(*LEFT_BEHIND))


def plant(tree: Path, at: str, find: str, put: str) -> None:
    """Change one place of a tree. Raises ValueError if it is not there, or not once."""
    path = tree / at
    lines = path.read_text("utf-8").splitlines()
    wanted = [_bare(line) for line in find.splitlines()]
    starts = [
        n
        for n in range(len(lines) - len(wanted) + 1)
        if all(_bare(line).startswith(word) for line, word in zip(lines[n:], wanted, strict=False))
    ]
    if len(starts) != 1:
        raise ValueError(f"{at}: {find!r} stands there {len(starts)} times")
    first, last = starts[0], starts[0] + len(wanted) - 1
    indent = lines[first][: len(lines[first]) - len(lines[first].lstrip())]
    tail = _bare(lines[last]).removeprefix(wanted[-1])
    words = put.splitlines()
    words[-1] += tail if words[-1].endswith("(") else ""
    lines[first : last + 1] = [indent + line for line in words]
    path.write_text("\n".join(lines) + "\n", "utf-8")


def _bare(line: str) -> str:
    return line.strip().replace("await ", "")


def places(fault: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Where a fault is planted: file, what stands there, what is put there."""
    here = [(fault["at"], fault["find"], fault["put"])]
    here += [(fault["at"], find, put) for find, put in fault.get("also", [])]
    return here + [tuple(place) for place in fault.get("more", [])]

"""Faults that are planted in a copy of the tree: `bench.planted` looks which part of the suite finds them."""

from __future__ import annotations

import re
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
    path, space = tree / at, re.escape(" ")
    text = path.read_text("utf-8")
    lines = [
        re.escape(line.strip()).replace(space, f"{space}(?:await )?")
        for line in find.replace("await ", "").splitlines()
    ]
    pattern = re.compile("^( *)(?:await )?" + r".*\n *(?:await )?".join(lines) + "(.*)$", re.M)
    found = pattern.findall(text)
    if len(found) != 1:
        raise ValueError(f"{at}: {find!r} stands there {len(found)} times")
    indent, tail = found[0]
    made = "\n".join(indent + line for line in put.splitlines()) + (tail if put.endswith("(") else "")
    path.write_text(pattern.sub(lambda _: made, text), "utf-8")


def places(fault: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Where a fault is planted: file, what stands there, what is put there."""
    here = [(fault["at"], fault["find"], fault["put"])]
    here += [(fault["at"], find, put) for find, put in fault.get("also", [])]
    return here + [tuple(place) for place in fault.get("more", [])]

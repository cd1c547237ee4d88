"""docs/glossary.md against the names in use: at most 60 terms, each at home somewhere, no second word for one thing."""

from __future__ import annotations

import ast
import importlib
import re
from functools import lru_cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("rig", "identify", "api", "hardware_sim", "stimrig")
ROWS = [
    [cell.strip().strip("`") for cell in line.strip("|").split("|")]
    for line in (ROOT / "docs" / "glossary.md").read_text("utf-8").splitlines()
    if line.startswith("| ") and not line.startswith("| term")
]


RIDDLES = {
    "laid",
    "flight",
    "handed",
    "gathered",
    "drawn",
    "felt",
    "told",
    "tells",
    "shown",
    "found",
    "opened",
    "answers",
}
"""Words that no room is called by: they say nothing of what is in it."""


@lru_cache
def names() -> dict[str, set[str]]:
    """The words of which names of modules, classes and functions are made, and where each stands."""
    found: dict[str, set[str]] = {}
    for path in (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))):
        tree = ast.parse(path.read_text("utf-8"))
        kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        for name in (path.stem, *(node.name for node in ast.walk(tree) if isinstance(node, kinds))):
            for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name):
                found.setdefault(word.lower(), set()).add(f"{path.relative_to(ROOT)}: {name}")
    return found


def test_it_is_short_and_has_each_term_once() -> None:
    terms = [row[0] for row in ROWS]
    assert 40 < len(terms) <= 60
    assert len(set(terms)) == len(terms)


@pytest.mark.parametrize("place", sorted({row[2] for row in ROWS}))
def test_a_term_is_at_home_in_a_module_or_a_type(place: str) -> None:
    module, _, name = place.rpartition(".")
    try:
        importlib.import_module(place)
    except ModuleNotFoundError:
        assert hasattr(importlib.import_module(module), name), place


@pytest.mark.parametrize("word", [word.strip() for row in ROWS for word in row[3].split(",") if word.strip()])
def test_no_name_has_the_word_that_is_not_used(word: str) -> None:
    assert names().get(word, set()) == set()


def test_every_term_is_in_use() -> None:
    used = names()
    unused = [
        row[0]
        for row in ROWS
        if not all(word.rstrip("s") in used or word in used for word in re.split(r"[ -]", row[0]))
    ]
    assert unused == []


def test_rooms_are_called_by_what_is_in_them() -> None:
    rooms = {path.stem for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    riddles = {room for room in rooms if set(room.split("_")) & RIDDLES or room.startswith(("by_", "of_", "with_"))}
    assert riddles == set()

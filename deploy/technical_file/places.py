"""Whether what a table names is there: tests as pytest would find them, places as paths or patterns of paths."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, cast

from stimrig.rig import devices

ROOT = Path(__file__).resolve().parents[2]
SAFETY = ROOT / "docs" / "safety"
TABLES = (
    "hazards", "requirements", "items", "threats", "use", "stimulator-standard", "activities", "data-map",
)  # fmt: skip
Row = dict[str, Any]
Tables = dict[str, Row]


def read() -> Tables:
    """Each table of docs/safety by its name. Raises OSError, tomllib.TOMLDecodeError."""
    return {name: tomllib.loads((SAFETY / f"{name}.toml").read_text("utf-8")) for name in TABLES}


@cache
def names_in(path: Path) -> frozenset[str]:
    """Names of the tests in a file as pytest would find them, without running it."""
    names = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
            inside = (n for n in node.body if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
            names |= {f"{node.name}::{n.name}" for n in inside}
    return frozenset(name for name in names if name.rpartition("::")[2].startswith("test_"))


def missing_tests(tests: Iterable[str]) -> Iterator[str]:
    """A line for each test that is named and not there."""
    for test in tests:
        path, _, name = test.partition("::")
        if not (path.startswith("tests/") and (ROOT / path).is_file() and name in names_in(ROOT / path)):
            yield f"no such test: {test}"


def missing_places(places: Iterable[str]) -> Iterator[str]:
    """A line for each place that is named and not there."""
    return (f"{place} is not there" for place in places if not files(place))


@cache
def files(place: str) -> frozenset[Path]:
    """A path or a pattern of paths; with a kind of devices in brackets, the drivers of that kind among them."""
    pattern, _, kind = place.removesuffix(")").partition(" (")
    return frozenset(path for path in ROOT.glob(pattern) if not kind or path.stem in devices.library(cast("Any", kind)))


def left_out(row: Row, *keys: str) -> Iterator[str]:
    """A line for each key that is empty or not there."""
    return (f"no {key}" for key in keys if not row.get(key))


def unique(rows: Iterable[Row], key: str = "id") -> Iterator[str]:
    """A line for each name that stands twice."""
    names = [row.get(key, "?") for row in rows]
    return (f"{name}: twice" for name in sorted({name for name in names if names.count(name) > 1}))

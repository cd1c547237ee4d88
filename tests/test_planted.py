"""A fault that `bench.planted` plants, or a mutation, is in what the suite imports; each still has its place."""

from __future__ import annotations

import tomllib
from pathlib import Path

from stimrig.rig import gate, limits, phase
from tests.harness.planted import copy_tree, places, plant, read_faults

ROOT = Path(__file__).parents[1]


def test_each_fault_has_one_place_and_is_imported_there(tmp_path: Path) -> None:
    for folder in ("rig", "stimrig"):
        copy_tree(ROOT / folder, tmp_path / folder)
    faults = read_faults()
    assert len(faults) > 30
    for fault in faults:
        there = places(fault)
        kept = {at: (tmp_path / at).read_text("utf-8") for at, _, _ in there}
        for at, find, put in there:
            plant(tmp_path, at, find, put)
        for at, text in kept.items():
            assert (tmp_path / "stimrig" / at).read_text("utf-8") != text, fault["name"]
            (tmp_path / at).write_text(text, "utf-8")


def test_what_mutmut_changes_is_what_is_imported() -> None:
    """It runs the tests in a copy of the tree, in which no link is one any more."""
    mutmut = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["mutmut"]
    imported = [f"{module.__name__.replace('.', '/')}.py" for module in (gate, limits, phase)]
    assert mutmut["only_mutate"] == imported
    assert {str(Path(path).parent) for path in imported} == set(mutmut["source_paths"])
    assert all((ROOT / path).is_file() for path in mutmut["pytest_add_cli_args_test_selection"])

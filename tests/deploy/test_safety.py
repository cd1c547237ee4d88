"""The risk file docs/safety/hazards.toml: each hazard has controls, each control names places and tests that exist."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, cast, get_args

from stimrig.rig import devices
from tests.simulator.invariants import INVARIANTS

ROOT = Path(__file__).parents[2]
HAZARDS: list[dict[str, Any]] = tomllib.loads((ROOT / "docs/safety/hazards.toml").read_text("utf-8"))["hazard"]
CONTROLS = [control for hazard in HAZARDS for control in hazard["control"]]


@cache
def names_of_tests(path: Path) -> set[str]:
    """Collect the names of the tests in a file as pytest would, without importing it."""
    names = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
            inside = (n for n in node.body if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
            names |= {f"{node.name}::{n.name}" for n in inside}
    return {name for name in names if name.rpartition("::")[2].startswith("test_")}


@cache
def places(pattern: str) -> set[Path]:
    """Find the files of a path or pattern; with a kind of device in brackets, only the drivers of that kind."""
    path, _, kind = pattern.removesuffix(")").partition(" (")
    return {found for found in ROOT.glob(path) if not kind or found.stem in devices.library(cast("Any", kind))}


def faults() -> Iterator[str]:
    invariants = {invariant.__name__ for invariant in INVARIANTS}
    for hazard in HAZARDS:
        name = hazard["id"]
        yield from (f"{name}: no {key}" for key in ("title", "harm", "causes", "control") if not hazard.get(key))
        if hazard["severity"] not in ("critical", "serious", "minor"):
            yield f"{name}: severity {hazard['severity']}"
        if hazard["severity"] == "critical" and len(hazard["control"]) < 2:
            yield f"{name}: critical, with a single control"
        yield from (f"{name}: no invariant {one}" for one in set(hazard.get("invariants", [])) - invariants)
    for control in CONTROLS:
        yield from (f"{control['what']}: no {key}" for key in ("where", "tests") if not control.get(key))
        yield from (f"{control['what']}: {place} does not exist" for place in control["where"] if not places(place))
        for test in control["tests"]:
            path, _, name = test.partition("::")
            if not (ROOT / path).is_file() or name not in names_of_tests(ROOT / path):
                yield f"{control['what']}: {test} does not exist"


def test_every_hazard_has_controls_and_every_control_places_and_tests_that_exist() -> None:
    assert list(faults()) == []
    names = [hazard["id"] for hazard in HAZARDS]
    assert len(names) == len(set(names))
    named = {invariant for hazard in HAZARDS for invariant in hazard.get("invariants", [])}
    assert named == {invariant.__name__ for invariant in INVARIANTS}, "each invariant guards against a hazard"


def test_every_driver_is_named_by_a_control() -> None:
    named = {path for control in CONTROLS for place in control["where"] for path in places(place)}
    drivers = {ROOT / "rig/devices" / f"{name}.py" for kind in get_args(devices.Kind) for name in devices.library(kind)}
    assert drivers <= named


LOADED = """
import importlib, json, pkgutil, sys
import stimrig.rig.__main__
from stimrig.rig import devices, sequences
for package in (devices, sequences):
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{package.__name__}.{module.name}")
for interface in ("socketcan", "socketcand", "slcan"):
    importlib.import_module(f"can.interfaces.{interface}")
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def test_the_rigs_process_loads_few_packages() -> None:
    answer = subprocess.run([sys.executable, "-c", LOADED], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(json.loads(answer.stdout))
    assert {"numpy", "serial", "can", "pydantic", "h5py"} <= loaded
    assert not {"numba", "scipy", "fastapi", "sqlalchemy", "httpx", "pandas"} & loaded

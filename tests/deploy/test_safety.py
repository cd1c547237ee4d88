"""The risk file keeps its word: every hazard has controls, every control names tests and places that are there."""

from __future__ import annotations

import importlib.metadata
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any, get_args

import pytest

from deploy import soup
from deploy.technical_file import places, traces
from stimrig.rig import devices
from tests.simulator.invariants import INVARIANTS

ROOT = Path(__file__).parents[2]
HAZARDS = ROOT / "docs" / "safety" / "hazards.toml"


def faults(hazards: list[dict[str, Any]]) -> list[str]:
    """What does not hold in a list of hazards, a line each."""
    return list(traces.hazard_faults(hazards, {invariant.__name__ for invariant in INVARIANTS}))


def hazards() -> list[dict[str, Any]]:
    return tomllib.loads(HAZARDS.read_text("utf-8"))["hazard"]


def test_every_hazard_has_controls_and_every_control_tests_that_are_there() -> None:
    assert faults(hazards()) == []


def test_every_invariant_of_the_simulator_guards_against_a_hazard() -> None:
    named = {name for hazard in hazards() for name in hazard.get("invariants", [])}
    assert named == {invariant.__name__ for invariant in INVARIANTS}


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda h: h.pop("control"), "no control"),
        (lambda h: h["control"][0].pop("tests"), "no tests"),
        (lambda h: h["control"][0].update(tests=[]), "no tests"),
        (lambda h: h["control"][0]["tests"].append("tests/rig/test_limits.py::test_that_is_not_there"), "no such test"),
        (lambda h: h["control"][0]["tests"].append("tests/rig/test_nothing.py::test_x"), "no such test"),
        (lambda h: h["control"][0]["tests"].append("tests/rig/test_limits.py"), "no such test"),
        (lambda h: h["control"][0]["where"].append("rig/nowhere.py"), "is not there"),
        (lambda h: h["control"][0]["where"].append("rig/devices/*.py (pump)"), "is not there"),
        (lambda h: h["invariants"].append("nothing_ever_happens"), "no such invariant"),
        (lambda h: h.update(severity="harmless"), "severity"),
        (lambda h: h.update(causes=[]), "no causes"),
        (lambda h: h.update(id="H02"), "twice"),
        (lambda h: h["control"][0].pop("requirement"), "no requirement"),
        (lambda h: h.update(control=h["control"][:1]), "one control alone"),
    ],
)
def test_what_does_not_hold_is_found(spoil: Any, told: str) -> None:
    spoiled = hazards()
    spoil(spoiled[0])
    assert any(told in fault for fault in faults(spoiled))


def test_every_driver_is_named_by_a_control_that_is_tested() -> None:
    named = {
        path
        for hazard in hazards()
        for one in hazard["control"]
        for place in one["where"]
        for path in places.files(place)
    }
    drivers = {
        ROOT / "rig" / "devices" / f"{name}.py" for kind in get_args(devices.Kind) for name in devices.library(kind)
    }
    assert drivers <= named


def test_it_says_plainly_that_it_is_no_certified_device() -> None:
    for name in ("README.md", "intended-use.md"):
        assert "not a certified medical device" in (ROOT / "docs" / "safety" / name).read_text("utf-8")


def test_the_list_of_others_software_is_up_to_date() -> None:
    assert soup.LIST.read_text("utf-8") == soup.render(), "run deploy/soup.py"


def test_an_outdated_list_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock = soup.LOCK.read_text("utf-8")
    changed = tmp_path / "run.txt"
    monkeypatch.setattr(soup, "LOCK", changed)
    changed.write_text(re.sub(r"^pyserial==\S+", "pyserial==99.0", lock, flags=re.M))
    assert soup.main(["--check"]) == 1
    changed.write_text(lock + "leftpad==1.0 \\\n    --hash=sha256:00\n")
    with pytest.raises(soup.SoupError, match="no note for: leftpad"):
        soup.render()
    changed.write_text(re.sub(r"^pyserial==.*$", "", lock, flags=re.M))
    with pytest.raises(soup.SoupError, match="no longer locked: pyserial"):
        soup.render()
    changed.write_text("git+https://somewhere/x\n")
    with pytest.raises(soup.SoupError, match=r"run.txt:1: not a pin"):
        soup.render()


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


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda n: n["anomalies"].pop("pyserial"), "not looked at: pyserial"),
        (lambda n: n["anomalies"].update(leftpad={}), "anomalies of no package: leftpad"),
        (lambda n: n["anomalies"]["pyserial"].update(known=" "), "anomalies.pyserial: needs must, known"),
        (lambda n: n["anomalies"]["pyserial"].update(looked_at="soon"), "anomalies.pyserial: needs must, known"),
    ],
)
def test_a_package_of_the_rig_that_nobody_looked_at_is_found(
    spoil: Any, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes = soup.notes()
    spoil(notes)
    monkeypatch.setattr(soup, "notes", lambda: notes)
    with pytest.raises(soup.SoupError, match=told):
        soup.render()


def test_what_the_rig_loads_is_classed_as_such() -> None:
    answer = subprocess.run([sys.executable, "-c", LOADED], cwd=ROOT, capture_output=True, text=True, check=True)
    owners = importlib.metadata.packages_distributions()
    normal = {re.sub(r"[-_.]+", "-", d).lower() for name in json.loads(answer.stdout) for d in owners.get(name, [])}
    classes = {name: note["class"] for name, note in soup.notes()["package"].items()}
    loaded = {name for name in normal if name in classes}
    assert {"numpy", "pyserial", "python-can", "pydantic", "h5py"} <= loaded
    assert {name: classes[name] for name in loaded if classes[name] != "rig"} == {}
    assert not {"numba", "scipy", "fastapi", "sqlalchemy"} & loaded

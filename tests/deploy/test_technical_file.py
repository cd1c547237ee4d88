"""The technical file keeps its word: its tables agree with the code, and each kind of contradiction is found."""

from __future__ import annotations

import copy
import fnmatch
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from deploy.technical_file import __main__ as technical_file
from deploy.technical_file import checks, figures, parts, places, release, traces
from stimrig.rig import limits
from tests.simulator.invariants import INVARIANTS

ROOT = Path(__file__).parents[2]
NAMES = {invariant.__name__ for invariant in INVARIANTS}


@cache
def tables() -> places.Tables:
    return places.read()


def test_file_and_code_agree() -> None:
    assert checks.faults(tables(), NAMES) == []


def first(rows: list[dict[str, Any]], name: str) -> dict[str, Any]:
    return next(row for row in rows if row["id"] == name)


def of_current(tables: Any) -> dict[str, Any]:
    return next(row for row in tables["stimulator-standard"]["clause"] if row.get("ours") == "rms_current_ma")


GATE = "pulse-limits"
SPOILED = [
    # requirements
    (lambda t: t["hazards"]["hazard"][0]["control"][0].update(requirement="nothing"), "no such requirement: nothing"),
    (lambda t: t["requirements"]["requirement"].append({"id": "loose", "text": "x"}), "requirement loose: no need"),
    (lambda t: first(t["requirements"]["requirement"], "identify").update(tests=[]), "identify: no tests"),
    (lambda t: first(t["requirements"]["requirement"], "identify").update(tests=["tests/x.py::y"]), "no such test"),
    (lambda t: first(t["requirements"]["requirement"], "identify").update(where=["gone"]), "gone is not there"),
    (lambda t: t["requirements"]["requirement"].append({"id": GATE, "text": "x"}), f"{GATE}: twice"),
    # items
    (lambda t: first(t["items"]["item"], "rig").update({"class": "B"}), "ask for C"),
    (lambda t: first(t["items"]["item"], "words").update(paths=["api/charts"]), "api/settings.py: belongs to no item"),
    (lambda t: first(t["items"]["item"], "doors").pop("relies_on"), "item doors: imports identification"),
    (lambda t: first(t["items"]["item"], "rig").pop("reason"), "item rig: no reason"),
    # threats
    (lambda t: first(t["threats"]["threat"], "T21").update(hazards=[]), "neither hazards, tests nor open"),
    (lambda t: first(t["threats"]["threat"], "T21").update(hazards=["H99"]), "no such hazard: H99"),
    (lambda t: t["threats"]["threat"].remove(first(t["threats"]["threat"], "T21")), "rig: no threat of T"),
    (lambda t: t["threats"]["threat"].remove(first(t["threats"]["threat"], "T37")), "push: no threat of TID"),
    (lambda t: first(t["threats"]["flow"], "push").update(to="nobody"), "no such element: nobody"),
    (lambda t: first(t["threats"]["element"], "rig").update(boundary="moon"), "element rig: no such boundary"),
    # use
    (lambda t: first(t["use"]["scenario"], "U01").update(tests=[]), "scenario U01: no tests"),
    (lambda t: first(t["use"]["scenario"], "U01").update(hazards=["H99"]), "scenario U01: no such hazard"),
    (lambda t: t["use"]["trial"][0]["quotes"].append("3 clicks"), "'3 clicks' is not in it"),
    # the stimulators' standard
    (lambda t: of_current(t).update(at_most=10.0), "is 17.8885, above 10"),
    (lambda t: of_current(t).update(ours="voltage_kv"), "no such figure: voltage_kv"),
    (lambda t: of_current(t).update(tests=[]), "no tests"),
    (lambda t: t["stimulator-standard"].update(electrode_area_cm2=5.0), "does not ask for electrodes of 5 cm²"),
    # activities, and what others must do
    (lambda t: t["activities"]["activity"][0].update(missing=""), "partly or not done with what is missing"),
    (lambda t: t["activities"]["activity"][0].update(where=["gone.md"]), "gone.md is not there"),
    (lambda t: t["activities"]["outside"][0].pop("owner"), "no owner"),
    # the map of data
    (lambda t: t["data-map"]["tables"].pop("notes"), "notes.text is not in it"),
    (lambda t: t["data-map"]["tables"]["notes"]["person"].remove("text"), "notes.text is not in it"),
    (lambda t: t["data-map"]["tables"]["notes"]["person"].append("mood"), "notes.mood is no longer there"),
    (lambda t: t["data-map"]["tables"]["notes"].pop("until"), "notes: no until"),
    (lambda t: t["data-map"]["files"].clear(), "no kind of file for latch.json, in rig/control/memory.py"),
    (lambda t: t["data-map"]["elsewhere"][0].update(tests=[]), "no tests"),
]


@pytest.mark.parametrize(("spoil", "told"), SPOILED, ids=[told for _, told in SPOILED])
def test_what_does_not_hold_is_found(spoil: Any, told: str) -> None:
    spoiled = copy.deepcopy(tables())
    spoil(spoiled)
    assert any(told in fault for fault in checks.faults(spoiled, NAMES))


def test_a_wider_limit_in_the_code_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    row = limits.HARD_LIMITS["charge_per_second_uc"]
    wide = limits.Limit(row.name, row.lo, row.hi * 10, row.unit, row.reason, row.source)
    monkeypatch.setattr(figures, "HARD_LIMITS", {**limits.HARD_LIMITS, row.name: wide})
    found = "\n".join(checks.standard_faults(tables()["stimulator-standard"]))
    assert "rms_current_ma is 56.5685, above 50" in found
    assert "rms_density_ma_cm2 is 5.65685, above 2" in found


def test_figures_are_those_of_the_worst_pulses_that_are_admitted() -> None:
    """Searched over all widths, currents and rates, as the limits admit them, with no formula of the file's."""
    table, load_ohm = limits.HARD_LIMITS, 500.0
    energies_mj, squares = [], []
    for width_us in range(10, 501, 10):
        for current_ma in range(2, 101, 2):
            if isinstance(limits.admit(limits.Pulse(width_us, current_ma), table), limits.Refusal):
                continue
            power_w, phases_s = (current_ma * 1e-3) ** 2 * load_ohm, 2 * width_us * 1e-6
            energies_mj.append(power_w * phases_s * 1e3)
            charge_uc = width_us * current_ma * 1e-3
            rate_hz = min(table["pulse_rate_hz"].hi, table["charge_per_second_uc"].hi / charge_uc)
            squares.append((current_ma**2) * phases_s * rate_hz)
    worst = figures.of_clauses(tables()["stimulator-standard"])
    assert max(energies_mj) == pytest.approx(worst["pulse_energy_mj"][0])
    assert max(squares) ** 0.5 == pytest.approx(worst["rms_current_ma"][0], rel=0.01)


def test_a_file_of_another_kind_is_not_in_the_map() -> None:
    for name in ("photo.jpg", "recordings/face.png", "names.json"):
        assert not checks.is_mapped(name, tables()["data-map"])


def test_the_printed_file_has_every_part(tmp_path: Path) -> None:
    dist, report = tmp_path / "dist", tmp_path / "tests.xml"
    dist.mkdir()
    (dist / "stimrig-9.whl").write_bytes(b"wheel")
    report.write_text('<testsuites><testsuite tests="7" failures="0" errors="0" skipped="1"/></testsuites>')
    technical_file.write(tmp_path / "out", dist, report)
    page = (tmp_path / "out" / "technical-file.html").read_text("utf-8")
    assert "<!-- table:" not in page
    for row in (*tables()["hazards"]["hazard"], *tables()["threats"]["threat"], *tables()["use"]["scenario"]):
        assert row["id"] in page
    for words in ("<svg", "17.89 mA", "ba599261", "7 tests", "H01", "pulse-limits", "page_sessions", "pyserial"):
        assert words in page, words
    assert set(re.findall(r'href="#([^"]+)"', page)) <= set(re.findall(r'id="([^"]+)"', page))


def test_without_a_release_the_record_says_so() -> None:
    assert release.record(None, None).count(release.OPEN) >= 2
    assert f"stimrig {release.version()}" in release.record(None, None)


def test_every_mark_has_its_part_and_every_page_its_place() -> None:
    pages = {path.stem for path in places.SAFETY.glob("*.md")} - {"soup"}
    assert pages == set(technical_file.PAGES)
    marks = {mark for page in pages for mark in technical_file.MARK.findall((places.SAFETY / f"{page}.md").read_text())}
    assert all(hasattr(parts, mark.replace("-", "_")) for mark in marks - {"release", "soup"})
    named = fnmatch.filter((path.name for path in places.SAFETY.glob("*.toml")), "*.toml")
    assert {f"{name}.toml" for name in places.TABLES} | {"decisions.toml"} == set(named)


def test_a_contradiction_is_told_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spoiled = copy.deepcopy(tables())
    spoiled["use"]["scenario"][0]["tests"] = []
    monkeypatch.setattr(places, "read", lambda: spoiled)
    assert technical_file.main(["--to", str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err.splitlines() == ["scenario U01: no tests"]
    assert not (tmp_path / "out").exists()


def test_the_rig_is_of_the_highest_class_and_imports_nothing_below() -> None:
    items = tables()["items"]["item"]
    assert traces.item_of("rig/gate.py", items) is first(items, "rig")
    assert {other for one, other in traces.interfaces(items) if one == "rig"} == set()


@pytest.mark.parametrize("option", ["--dist", "--tests"])
def test_what_is_not_there_is_a_mistake_in_the_arguments(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        technical_file.main([option, "nowhere"])
    assert caught.value.code == 2
    assert f"{option} nowhere: no f" in capsys.readouterr().err

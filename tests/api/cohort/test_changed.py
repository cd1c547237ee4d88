"""Two runs compared: a change is named with its reason, noise is no change, records of one run only are listed."""

from __future__ import annotations

import hashlib
from copy import deepcopy
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from stimrig.api.cli.commands.cohort import changed_lines
from stimrig.api.cohort import changed
from stimrig.api.cohort.changed import compare_runs
from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.results import Results
from stimrig.api.cohort.task import Task

pytestmark = pytest.mark.slow


def row(name: str, **more: Any) -> dict[str, Any]:
    found = {
        "address": f"/d/{name}", "name": name, "record_id": name, "stamp": name, "bytes": 3, "status": "ok",
        "sha256": hashlib.sha256(name.encode()).hexdigest(), "participant": "P001", "day": date(2026, 1, 5),
        "verdict": "effect_missing", "probability": 0.9, "held_out_rms_nm": 0.2,
        "effects": [{"effect": "fatigue", "probability": 0.9}],
        "parameters": [
            {"of": "fatigue", "name": "depth", "value": 0.5, "sd": 0.1, "unit": "1"},
            {"of": "fatigue", "name": "onset_s", "value": 90.0, "sd": None, "unit": "s"},
        ],
    }  # fmt: skip
    return deepcopy({**found, **more})


def failed(name: str, kind: str = "timeout", **more: Any) -> dict[str, Any]:
    found = row(name, status="error", error_kind=kind, error=f"it was {kind}", **more)
    return {**found, "verdict": None, "effects": None, "parameters": None, "probability": None, "held_out_rms_nm": None}


def written(path: Path, *rows: dict[str, Any], verb: str = "diagnose", software: str = "1.0") -> Path:
    with Results(path, Task(verb, software=software)) as results:
        for one in rows:
            results.add(one)
        results.join()
    return path


def differences(tmp_path: Path, old: dict[str, Any], new: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Kinds and reasons of one record."""
    before = written(tmp_path / "old.parquet", old)
    after = written(tmp_path / "new.parquet", new, software="2.0")
    found = compare_runs(before, after)
    assert found["compared"] == 1
    return (found["records"][0]["kinds"], found["records"][0]["why"]) if found["records"] else ([], [])


def with_parameter(number: int, **more: Any) -> dict[str, Any]:
    found = row("a")
    found["parameters"][number] |= more
    return found


@pytest.mark.parametrize(
    ("new", "kind", "why"),
    [
        (row("a", verdict="nothing_missing", effects=[], parameters=[]), "verdict",
         "effect missing → nothing missing"),
        (row("a", effects=[]), "effect lost", "fatigue lost (probability 0.9)"),
        (row("a", effects=[{"effect": "fatigue", "probability": 0.9}, {"effect": "tremor", "probability": 0.7}]),
         "effect gained", "tremor gained (probability 0.7)"),
        (row("a", effects=[{"effect": "fatigue", "probability": 0.8}]), "probability", "fatigue 0.9 → 0.8"),
        (row("a", probability=0.5), "probability", "of the verdict 0.9 → 0.5"),
        (with_parameter(0, value=0.61), "parameter", "fatigue depth 0.5 → 0.61 (sd 0.1)"),
        (with_parameter(1, value=95.0), "parameter", "fatigue onset_s 90 → 95 s"),
        (row("a", held_out_rms_nm=0.3), "held-out error", "0.2 → 0.3 N·m"),
        (failed("a"), "ok to error", "now timeout: it was timeout"),
    ],
)  # fmt: skip
def test_change_is_named(tmp_path: Path, new: dict[str, Any], kind: str, why: str) -> None:
    kinds, reasons = differences(tmp_path, row("a"), new)
    assert kinds[0] == kind
    assert any(why in reason for reason in reasons), reasons


@pytest.mark.parametrize(
    "new",
    [
        row("a"),
        row("a", probability=0.9 + 1e-9, held_out_rms_nm=0.2000001),
        row("a", effects=[{"effect": "fatigue", "probability": 0.94}]),
        with_parameter(0, value=0.59),
        with_parameter(1, value=90.5),
        with_parameter(0, value=0.7, sd=0.25),
        row("a", address="/elsewhere/a", took_s=99.0),
    ],
)
def test_noise_is_no_change(tmp_path: Path, new: dict[str, Any]) -> None:
    assert differences(tmp_path, row("a"), new) == ([], [])


@pytest.mark.parametrize(
    ("new", "kinds"),
    [(row("a"), ["error to ok"]), (failed("a", "bad record"), ["other error"]),
     ({**failed("a"), "error": "in other words"}, [])],
)  # fmt: skip
def test_errors_are_compared_by_their_kind(tmp_path: Path, new: dict[str, Any], kinds: list[str]) -> None:
    assert differences(tmp_path, failed("a"), new)[0] == kinds


@pytest.mark.parametrize("shares", [1, 3])
def test_counts_and_records_of_one_run_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shares: int) -> None:
    monkeypatch.setattr(changed, "ROWS_AT_ONCE", 100 if shares == 1 else 3)
    unread = failed("far", "unreadable", sha256=None)
    old = written(tmp_path / "old.parquet", *(row(name) for name in "abcd"), unread, failed("x", sha256=None),
                  failed("y", sha256=None))  # fmt: skip
    new = written(
        tmp_path / "new.parquet", row("a"), row("b", probability=0.1), row("c", verdict="nothing_missing"), row("e"),
        row("far"), failed("x", sha256=None), failed("z", sha256=None), software="2.0",
    )  # fmt: skip
    found = compare_runs(old, new)
    assert (found["compared"], found["unchanged"], found["changed"]) == (5, 2, 3)
    assert found["counts"] == {"error to ok": 1, "verdict": 1, "probability": 1}
    assert [one["record"] for one in found["records"]] == ["far", "c", "b"]
    assert (found["only_in_old"], found["only_in_new"]) == (["d", "y"], ["e", "z"])
    assert (found["old"]["software"], found["new"]["software"]) == ("1.0", "2.0")
    assert found["other_options"] == ""


def test_other_options_are_told(tmp_path: Path) -> None:
    old, new = written(tmp_path / "o.parquet", row("a")), tmp_path / "n.parquet"
    with Results(new, Task("diagnose", method="ridge", effects=("auto",), software="2.0")) as results:
        results.add(row("a"))
        results.join()
    found = compare_runs(old, new)
    assert found["other_options"] == "method maximum-likelihood, now ridge, effects none, now auto"
    assert f"made with other options: {found['other_options']}" in changed_lines(found)


def test_results_of_two_verbs_are_refused(tmp_path: Path) -> None:
    old, new = written(tmp_path / "o.parquet", row("a")), written(tmp_path / "n.parquet", row("a"), verb="fit")
    with pytest.raises(CohortError, match="of one verb"):
        compare_runs(old, new)
    with pytest.raises(CohortError, match="no such file"):
        compare_runs(old, tmp_path / "nowhere.parquet")
    (tmp_path / "x.parquet").write_bytes(b"x")
    with pytest.raises(CohortError, match="no table of results"):
        compare_runs(tmp_path / "x.parquet", new)

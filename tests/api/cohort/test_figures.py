"""Figures over a cohort: counted over people, units on every axis, and words where there is too little."""

from __future__ import annotations

import hashlib
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from stimrig.api.cli.commands.cohort import changed_lines
from stimrig.api.cohort import changed, figures
from stimrig.api.cohort.changed import compared
from stimrig.api.cohort.results import Results
from stimrig.api.cohort.statistics import read_statistics, repeatability, wilson
from stimrig.api.cohort.tasks import CohortError, Task

pytestmark = pytest.mark.slow


def session(who: int, week: int, tired: bool = False, **more: Any) -> dict[str, Any]:
    chance = 0.9 if tired else 0.3
    parameters = [
        {"of": "model", "name": "plateau_nm", "value": 10.0 * who + 0.1 * week, "sd": 0.05, "unit": "N·m"},
        {"of": "model", "name": "damping", "value": 0.7, "sd": None, "unit": "1"},
    ]
    return row(
        f"{who}-{week}", participant=f"P{who}", day=f"2026-01-{1 + 7 * week:02d}", parameters=parameters,
        effects=[{"effect": "fatigue", "probability": chance}], **more,
    )  # fmt: skip


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Six people, two sessions each: two tired in both, one in one; and three failures."""
    rows = [session(who, week, tired=who < 2 or (who == 2 and week == 0)) for who in range(6) for week in range(2)]
    return written(tmp_path / "r.parquet", *rows, failed("x"), failed("y"), failed("z", "bad record"))


def test_effects_are_counted_over_people(results: Path) -> None:
    found = read_statistics(results)
    assert (found.records, found.ok) == (15, 12)
    assert found.prevalence() == ("participants", 6, [("fatigue", 2)])  # the third is tired as often as not
    figure = figures.prevalence(found)
    assert figure is not None
    trace = figure["data"][0]
    low, high = wilson(2, 6)
    assert trace["x"] == [pytest.approx(100 / 3)] and trace["y"] == ["fatigue"]
    assert trace["x"][0] - trace["error_x"]["arrayminus"][0] == pytest.approx(100 * low)
    assert trace["x"][0] + trace["error_x"]["array"][0] == pytest.approx(100 * high)


def test_without_codes_records_are_counted(tmp_path: Path) -> None:
    rows = [session(0, 0, tired=True) | {"participant": None}, session(1, 0)]
    assert read_statistics(written(tmp_path / "r.parquet", *rows)).prevalence() == ("records", 2, [("fatigue", 1)])


def test_every_axis_has_its_unit(results: Path) -> None:
    found = read_statistics(results)
    titles = {}
    for key in figures.ranked_parameters(found):
        figure = figures.over_sessions(found, key)
        assert figure is not None
        assert "date, UTC" in figure["layout"]["xaxis"]["title"]["text"]
        titles[key[1]] = figure["layout"]["yaxis"]["title"]["text"]
        assert len(figure["data"]) == 6 and all(len(trace["x"]) == 2 for trace in figure["data"])
    assert titles == {"plateau_nm": "plateau (N·m)", "damping": "damping (1)"}
    shares, reasons = figures.prevalence(found), figures.errors(found)
    assert shares is not None and "%" in shares["layout"]["xaxis"]["title"]["text"]
    assert reasons is not None and "number, of 15" in reasons["layout"]["xaxis"]["title"]["text"]
    assert dict(zip(reasons["data"][0]["y"], reasons["data"][0]["x"], strict=True)) == {"timeout": 2, "bad record": 1}


def test_repeatability_is_that_of_the_sessions(results: Path) -> None:
    (plateau,) = [one for one in figures.repeats(read_statistics(results)) if one["parameter"] == "plateau"]
    assert plateau["within_sd"] == pytest.approx(0.1 / 2**0.5)
    assert plateau["icc"] == pytest.approx(1.0, abs=1e-4)
    assert (plateau["participants"], plateau["sessions"], plateau["few"]) == (6, 12, False)


def test_parameters_are_those_of_effects_that_count_each_form_by_itself(tmp_path: Path) -> None:
    """What is called the same in two forms of an effect is two quantities; what is improbable counts nowhere."""

    def made(week: int, form: str, chance: float | None) -> dict[str, Any]:
        reach = {"of": "recruitment_hysteresis", "name": "reach_us", "value": 70.0 + week, "sd": 1.0, "unit": "µs"}
        effect = {"effect": "recruitment_hysteresis", "form": form, "probability": chance}
        return {**session(0, week), "effects": [effect], "parameters": [reach]}

    rows = [made(0, "gain", 0.9), made(1, "two_curves", 0.9), made(2, "gain", 0.45), made(3, "gain", None)]
    found = read_statistics(written(tmp_path / "r.parquet", *rows))
    gain, curves = (("recruitment_hysteresis (" + form + ")", "reach_us") for form in ("gain", "two_curves"))
    assert {key: list(series.value) for key, series in found.series.items()} == {gain: [70.0, 73.0], curves: [71.0]}
    assert figures.title_of(curves) == "recruitment hysteresis (two curves): reach"
    assert [one["between_sd"] for one in figures.repeats(found)] == [None], "of one person"


def test_the_page_stands_alone_and_a_code_is_never_a_link(results: Path, tmp_path: Path) -> None:
    text = figures.page(read_statistics(results), "<b>r</b>.parquet")
    assert "<b>r</b>" not in text and "ICC" in text and text.count("<h2>") == 4
    assert "sendDataToCloud" not in text.split("Plotly.newPlot")[-1]
    bad = [{**session(0, week), "participant": '<a href="x">'} for week in range(2)]
    drawing = figures.over_sessions(read_statistics(written(tmp_path / "bad.parquet", *bad)), ("model", "plateau_nm"))
    assert drawing is not None and "<" not in drawing["data"][0]["name"]


def test_too_few_is_said(tmp_path: Path) -> None:
    found = read_statistics(written(tmp_path / "r.parquet", session(0, 0, tired=True)))
    text = figures.page(found, "r.parquet")
    assert figures.NOTHING in text and "Only 1 participants" in text and figures.repeats(found) == []
    none = figures.page(read_statistics(written(tmp_path / "e.parquet", failed("x"))), "e.parquet")
    assert "No effect was found" in none


def test_no_results_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(CohortError, match="no such file"):
        read_statistics(tmp_path / "nowhere.parquet")
    with pytest.raises(CohortError, match="no record"):
        read_statistics(written(tmp_path / "r.parquet"))


# ---- Two runs compared: what changed is named with its reason, noise is not, and who is in one only is told


def row(name: str, **more: Any) -> dict[str, Any]:
    found = {
        "address": f"/d/{name}", "name": name, "record_id": name, "stamp": name, "status": "ok",
        "sha256": hashlib.sha256(name.encode()).hexdigest(), "participant": "P001", "day": "2026-01-05",
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


def of(tmp_path: Path, old: dict[str, Any], new: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Kinds and reasons of one record."""
    before = written(tmp_path / "old.parquet", old)
    after = written(tmp_path / "new.parquet", new, software="2.0")
    found = compared(before, after).to_dict()
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
def test_a_change_is_named(tmp_path: Path, new: dict[str, Any], kind: str, why: str) -> None:
    kinds, reasons = of(tmp_path, row("a"), new)
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
    assert of(tmp_path, row("a"), new) == ([], [])


@pytest.mark.parametrize(
    ("new", "kinds"),
    [(row("a"), ["error to ok"]), (failed("a", "bad record"), ["other error"]),
     ({**failed("a"), "error": "in other words"}, [])],
)  # fmt: skip
def test_errors_are_compared_by_their_kind(tmp_path: Path, new: dict[str, Any], kinds: list[str]) -> None:
    assert of(tmp_path, failed("a"), new)[0] == kinds


@pytest.mark.parametrize("shares", [1, 3])
def test_counts_and_who_is_in_one_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shares: int) -> None:
    monkeypatch.setattr(changed, "ROWS_AT_ONCE", 100 if shares == 1 else 3)
    unread = failed("far", "unreadable", sha256=None)
    old = written(tmp_path / "old.parquet", *(row(name) for name in "abcd"), unread, failed("x", sha256=None),
                  failed("y", sha256=None))  # fmt: skip
    new = written(
        tmp_path / "new.parquet", row("a"), row("b", probability=0.1), row("c", verdict="nothing_missing"), row("e"),
        row("far"), failed("x", sha256=None), failed("z", sha256=None), software="2.0",
    )  # fmt: skip
    found = compared(old, new).to_dict()
    assert (found["compared"], found["unchanged"], found["changed"]) == (5, 2, 3)
    assert found["counts"] == {"error to ok": 1, "verdict": 1, "probability": 1}
    assert [one["record"] for one in found["records"]] == ["far", "c", "b"]
    assert (found["only_in_old"], found["only_in_new"]) == (["d", "y"], ["e", "z"])
    assert (found["old"]["software"], found["new"]["software"]) == ("1.0", "2.0")
    assert found["other_options"] == ""


def test_other_options_are_told(tmp_path: Path) -> None:
    """What changed need not be the new version's doing."""
    old, new = written(tmp_path / "o.parquet", row("a")), tmp_path / "n.parquet"
    with Results(new, Task("diagnose", method="ridge", effects=("auto",), software="2.0")) as results:
        results.add(row("a"))
        results.join()
    found = compared(old, new).to_dict()
    assert found["other_options"] == "method maximum-likelihood, now ridge, effects none, now auto"
    assert f"made with other options: {found['other_options']}" in changed_lines(found)


def test_results_of_two_verbs_are_refused(tmp_path: Path) -> None:
    old, new = written(tmp_path / "o.parquet", row("a")), written(tmp_path / "n.parquet", row("a"), verb="fit")
    with pytest.raises(CohortError, match="of one verb"):
        compared(old, new)
    with pytest.raises(CohortError, match="no such file"):
        compared(old, tmp_path / "nowhere.parquet")
    (tmp_path / "x.parquet").write_bytes(b"x")
    with pytest.raises(CohortError, match="no table of results"):
        compared(tmp_path / "x.parquet", new)


# ---- Figures with known answers


def test_the_interval_of_a_share() -> None:
    """Newcombe 1998, Statistics in Medicine 17:857, table I, method 3."""
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(5, 5)[1] == 1.0


def test_repeatability_of_a_known_table() -> None:
    """Shrout and Fleiss 1979, Psychological Bulletin 86:420: ICC(1,1) of their table 2 is 0.17."""
    rows = [(9, 2, 5, 8), (6, 1, 3, 2), (8, 4, 6, 8), (7, 1, 2, 6), (10, 5, 6, 9), (6, 2, 4, 7)]
    found = repeatability([[float(value) for value in row] for row in rows])
    assert found is not None
    assert found.icc == pytest.approx(0.166, abs=5e-4)
    assert found.within_sd**2 == pytest.approx(6.264, abs=5e-4)
    assert (found.participants, found.sessions) == (6, 24)


def test_too_few_say_less() -> None:
    assert repeatability([]) is None
    assert repeatability([[1.0], [2.0]]) is None
    one = repeatability([[1.0, 3.0], [7.0]])
    assert one is not None
    assert (one.participants, one.sessions, one.between_sd, one.icc) == (1, 2, None, None)
    assert one.within_sd == pytest.approx(2**0.5)
    both_signs = repeatability([[-1.0, 1.0], [0.5, -0.5]])
    assert both_signs is not None and both_signs.cv_percent is None
    same = repeatability([[2.0, 2.0], [2.0, 2.0]])
    assert same is not None and same.icc is None and same.within_sd == 0.0

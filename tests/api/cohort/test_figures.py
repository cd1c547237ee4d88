"""Figures over a cohort: counted over people, units on every axis, and words where there is too little."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from stimrig.api.cohort import figures
from stimrig.api.cohort.statistics import read_statistics, wilson
from stimrig.api.cohort.tasks import CohortError
from tests.api.cohort.test_changed import failed, row, written


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

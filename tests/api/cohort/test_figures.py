"""The page of a cohort: counted over people, units on every axis, and words where there is too little."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.figures import (
    Cohort,
    draw_prevalence,
    draw_sessions,
    page,
    read_cohort,
    repeatability,
    title_of,
    wilson,
)  # fmt: skip
from tests.api.cohort.test_changed import failed, row, written

pytestmark = pytest.mark.slow


def session(person: int, week: int, tired: bool = False, **more: Any) -> dict[str, Any]:
    parameters = [
        {"of": "model", "name": "plateau_nm", "value": 10.0 * person + 0.1 * week, "sd": 0.05, "unit": "N·m"},
        {"of": "model", "name": "damping", "value": 0.7, "sd": None, "unit": "1"},
    ]
    found = row(
        f"{person}-{week}", participant=f"P{person}", day=date(2026, 1, 1 + 7 * week), parameters=parameters,
        effects=[{"effect": "fatigue", "probability": 0.9 if tired else 0.3}],
    )  # fmt: skip
    return found | more


@pytest.fixture
def cohort(tmp_path: Path) -> Cohort:
    """Six people, two sessions each: two tired in both, one in one; and three failures."""
    rows = [session(code, week, tired=code < 2 or (code == 2 and week == 0)) for code in range(6) for week in range(2)]
    return of(tmp_path, *rows, failed("x"), failed("y"), failed("z", "bad record"))


def of(tmp_path: Path, *rows: dict[str, Any]) -> Cohort:
    return read_cohort(written(tmp_path / "r.parquet", *rows))


def test_effects_are_counted_over_people(cohort: Cohort) -> None:
    assert (cohort.ok, cohort.errors) == (12, {"timeout": 2, "bad record": 1})
    assert cohort.prevalence() == ("participants", 6, [("fatigue", 2)]), "the third is tired as often as not"


def test_without_codes_records_are_counted(tmp_path: Path) -> None:
    rows = [session(0, 0, tired=True, participant=None), session(1, 0)]
    assert of(tmp_path, *rows).prevalence() == ("records", 2, [("fatigue", 1)])


def test_every_axis_has_its_unit(cohort: Cohort) -> None:
    figure = draw_prevalence(cohort)
    assert figure is not None and "%" in figure.axes[0].get_xlabel()
    labels = {}
    for key in cohort.ranked_parameters():
        figure = draw_sessions(cohort, key)
        assert figure is not None and "date, UTC" in figure.axes[0].get_xlabel()
        assert [np.shape(line.get_xydata()) for line in figure.axes[0].get_lines()] == [(2, 2)] * 6
        labels[key[1]] = figure.axes[0].get_ylabel()
    assert labels == {"plateau_nm": "plateau (N·m)", "damping": "damping (1)"}


def test_parameters_are_those_of_effects_that_count_each_form_by_itself(tmp_path: Path) -> None:
    """The same name in two forms of an effect is two quantities; what is improbable counts nowhere."""

    def made(week: int, form: str, probability: float | None) -> dict[str, Any]:
        reach = {"of": "recruitment_hysteresis", "name": "reach_us", "value": 70.0 + week, "sd": 1.0, "unit": "µs"}
        effect = {"effect": "recruitment_hysteresis", "form": form, "probability": probability}
        return session(0, week, effects=[effect], parameters=[reach])

    cohort = of(
        tmp_path, made(0, "gain", 0.9), made(1, "two_curves", 0.9), made(2, "gain", 0.45), made(3, "gain", None)
    )
    values = {key: [value for _, value, _ in parameter.sessions["P0"]] for key, parameter in cohort.parameters.items()}
    gain, curves = (("recruitment_hysteresis (" + form + ")", "reach_us") for form in ("gain", "two_curves"))
    assert values == {gain: [70.0, 73.0], curves: [71.0]}
    assert title_of(curves) == "recruitment hysteresis (two curves): reach"
    assert [one["between_sd"] for one in cohort.repeatability()] == [None], "of one person"


def test_page_stands_alone(cohort: Cohort, tmp_path: Path) -> None:
    text = page(cohort, "<b>r</b>.parquet")
    assert "<b>r</b>" not in text and "ICC" in text and text.count("<h2>") == 4 and text.count("<img") == 3
    assert "33.3 % (9.7 to 70.0)" in text and "http" not in text
    page(of(tmp_path, *(session(0, week, participant="$\\a<b>") for week in range(2))), "r.parquet")


def test_too_few_is_said(tmp_path: Path) -> None:
    text = page(of(tmp_path, session(0, 0, tired=True)), "r.parquet")
    assert text.count("Too few") == 2 and "Only 1 participants" in text
    (tmp_path / "none").mkdir()
    assert "No effect was found" in page(of(tmp_path / "none", failed("x")), "r.parquet")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CohortError, match="no record"):
        of(tmp_path / "empty")


def test_repeatability_is_that_of_the_sessions(cohort: Cohort) -> None:
    (plateau,) = [one for one in cohort.repeatability() if one["parameter"] == "plateau"]
    assert plateau["within_sd"] == pytest.approx(0.1 / 2**0.5)
    assert plateau["icc"] == pytest.approx(1.0, abs=1e-4)
    assert (plateau["participants"], plateau["sessions"], plateau["few"]) == (6, 12, False)


def test_interval_of_a_share() -> None:
    """Newcombe 1998, Statistics in Medicine 17:857, table I, method 3."""
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)


def test_repeatability_of_a_known_table() -> None:
    """Shrout and Fleiss 1979, Psychological Bulletin 86:420: ICC(1,1) of their table 2 is 0.17."""
    rows = [(9, 2, 5, 8), (6, 1, 3, 2), (8, 4, 6, 8), (7, 1, 2, 6), (10, 5, 6, 9), (6, 2, 4, 7)]
    found = repeatability([[float(value) for value in row] for row in rows])
    assert found is not None and (found["participants"], found["sessions"]) == (6, 24)
    assert found["icc"] == pytest.approx(0.166, abs=5e-4)
    assert found["within_sd"] ** 2 == pytest.approx(6.264, abs=5e-4)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([], None),
        ([[1.0], [2.0]], None),
        ([[1.0, 3.0], [7.0]], {"participants": 1, "sessions": 2, "between_sd": None, "icc": None}),
        ([[-1.0, 1.0], [0.5, -0.5]], {"cv_percent": None}),
        ([[2.0, 2.0], [2.0, 2.0]], {"icc": None, "within_sd": 0.0}),
    ],
)
def test_too_few_values_say_less(values: list[list[float]], expected: dict[str, Any] | None) -> None:
    found = repeatability(values)
    assert found is None if expected is None else found is not None and expected.items() <= found.items()

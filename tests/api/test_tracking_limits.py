"""How far a person lets a model be tracked: what is refused, what is within, and what is said beyond it."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest

from stimrig.api import language
from stimrig.api.errors import ApiError
from stimrig.api.models import tracking
from stimrig.api.models.tracking import Limits


def step(outcome: str = "followed", **coming: float) -> dict[str, Any]:
    values = {"gain": 1.0, "threshold_shift_us": 0.0, "time_scale": 1.0} | coming
    levels = {name: {"value": value, "low": value, "high": value} for name, value in values.items()}
    return {"outcome": outcome, "now": levels, "coming": levels, "error_nm": 0.3, "expected_error_nm": 0.05}


@pytest.mark.parametrize("percent", [-0.001, 60.001, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["gain_percent", "threshold_percent", "time_scale_percent"])
def test_what_is_not_from_0_to_60_is_refused(name: str, percent: float) -> None:
    with pytest.raises(ApiError, match=name) as refused:
        Limits(**{name: percent})
    assert refused.value.status == 422


@pytest.mark.parametrize("percent", [0.0, 20.0, 60.0])
def test_the_ends_hold(percent: float) -> None:
    assert Limits(percent, percent, percent).allows == (percent > 0.0)


def test_bounds_are_in_the_quantities_units() -> None:
    assert Limits(20.0, 10.0, 50.0).bounds(80.0) == {
        "gain": (0.8, 1.2), "threshold_shift_us": (-8.0, 8.0), "time_scale": (0.5, 1.5),
    }  # fmt: skip
    assert Limits(0.0, 10.0, 0.0).bounds(80.0) == {"threshold_shift_us": (-8.0, 8.0)}
    assert Limits(0.0, 10.0, 0.0).alarms(80.0) == {
        "gain": (0.8, 1.2), "threshold_shift_us": (-8.0, 8.0), "time_scale": (0.8, 1.2),
    }  # fmt: skip
    for without in (None, 0.0, -3.0):
        assert "threshold_shift_us" not in Limits().bounds(without), "no threshold to be a share of"


@pytest.mark.parametrize(
    ("coming", "words"),
    [
        ({"gain": 0.7999}, "the gain is expected just beyond the 80 to 120 % of the approved one that are allowed."),
        ({"gain": 0.79}, "the gain is expected to be 79.0 % of the approved one; 80 to 120 % are allowed."),
        ({"gain": 1.21}, "121.0 %"),
        ({"threshold_shift_us": 16.01}, "the threshold is expected just beyond the 16 µs that it may move."),
        ({"threshold_shift_us": 16.2}, "the threshold is expected to have moved by +16.2 µs; 16 µs either way are"),
        ({"threshold_shift_us": -17.0}, "-17.0 µs"),
        ({"time_scale": 0.5}, "the time scale is expected to be 50.0 % of the approved one"),
        ({"gain": math.nan}, "it is unknown what to expect of the gain."),
        ({"threshold_shift_us": math.inf}, "it is unknown what to expect of the threshold."),
    ],
)
def test_beyond_a_bound_a_person_is_asked(coming: dict[str, float], words: str) -> None:
    said = tracking.ask(4, step(**coming), Limits().bounds(80.0))
    assert said is not None and words in said and said.endswith(tracking.NEW_TEST)


@pytest.mark.parametrize(
    "coming", [{}, {"gain": 0.8}, {"gain": 1.2}, {"threshold_shift_us": 16.0}, {"time_scale": 0.81}]
)
def test_within_them_nobody_is_asked(coming: dict[str, float]) -> None:
    assert tracking.ask(4, step(**coming), Limits().bounds(80.0)) is None


def test_a_number_that_json_has_not_is_beyond_every_bound() -> None:
    without = step()
    without["coming"] = {**without["coming"], "gain": {"value": None}}
    assert "unknown what to expect of the gain" in str(tracking.ask(1, without, Limits().bounds(80.0)))


def test_limits_are_written_as_they_were_approved() -> None:
    bounds = Limits(12.5, 20.0, 0.4).bounds(83.37)
    assert "; 87.5 to 112.5 % are allowed." in str(tracking.ask(1, step(gain=0.874), bounds))
    assert "; 99.6 to 100.4 % are allowed." in str(tracking.ask(1, step(time_scale=0.9), bounds))
    assert "just beyond the 16.7 µs" in str(tracking.ask(1, step(threshold_shift_us=16.69), bounds))


def test_what_is_not_tracked_asks_nobody() -> None:
    assert tracking.ask(1, step(gain=0.1), Limits(gain_percent=0.0).bounds(80.0)) is None


def test_a_trial_that_contradicts_the_structure_asks_whatever_is_expected() -> None:
    said = tracking.ask(2, step("contradicts"), Limits().bounds(80.0))
    assert said is not None and "Trial 2 contradicts the structure" in said and "6.0 times" in said


def test_next_to_no_torque_asks_for_a_look_at_the_electrodes_first() -> None:
    said = tracking.ask(3, step("no-torque"), Limits().bounds(80.0))
    assert said is not None and said.startswith("In trial 3 the pulses gave next to no torque. Look at the electrodes")
    assert said.endswith(tracking.NEW_TEST)


ASKED = [{"gain": 0.7}, {"gain": 0.7999}, {"threshold_shift_us": 30.0}, {"threshold_shift_us": 16.01},
         {"time_scale": 1.4}, {"time_scale": 1.2001}, {"time_scale": math.nan}]  # fmt: skip


@pytest.mark.parametrize("coming", ASKED)
@pytest.mark.parametrize("outcome", ["followed", "contradicts", "no-torque"])
def test_the_question_is_asked_in_german(coming: dict[str, float], outcome: str) -> None:
    said = tracking.ask(3, step(outcome, **coming), Limits().bounds(80.0))
    with language.using("de"):
        german = language.plain(said)
    assert german != said and " the " not in german and "Durchgang 3" in german
    assert not re.search(r"\b(gain|threshold|time scale|just|unknown)\b", german), german

"""Guided calibration: small steps, never above a limit, thresholds in order, a profile that ends with the day."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

import pytest

from stimrig.rig import limits, plan
from stimrig.rig.clock import utc_text
from stimrig.rig.control.calibration import Calibration, check_profile, end_of_day_s
from stimrig.rig.errors import PlanError, RefusedError
from stimrig.rig.limits import HARD_LIMITS, Steps
from stimrig.rig.messages import CalibrateStartRequest, FinishedEvent, Profile

NOON_S = datetime(2026, 3, 4, 12, tzinfo=UTC).timestamp()


def opened(**fields: Any) -> Calibration:
    request = CalibrateStartRequest(calibration_id="c1", participant="P01", by="therapist", **fields)
    return Calibration(request, HARD_LIMITS, NOON_S)


def play(calibration: Calibration, *directions: str) -> float:
    width_us = 0.0
    for direction in directions:
        width_us = calibration.next_width_us(direction)
        train = calibration.train(width_us)
        test = plan.build(train, calibration.table)
        assert test.pulse_width_us.max() == width_us
        assert test.duration_s == pytest.approx(calibration.request.train_s + 0.5)
        done = FinishedEvent(
            test_id=train.test_id, outcome="completed", recording_path=f"{train.test_id}.h5",
            summary={"charge_uc": test.charge_uc, "pulses": 40},
        )  # fmt: skip
        calibration.played(width_us, 0.1, done)
    return width_us


def profile(**fields: Any) -> Profile:
    known = {
        "max_pulse_width_us": 180.0,
        "sensory_pulse_width_us": 60.0,
        "motor_pulse_width_us": 100.0,
        "set_at_utc": utc_text(NOON_S - 3600),
        "expires_at_utc": utc_text(NOON_S + 3600),
    }
    return Profile(**(known | fields))


def test_steps_marks_and_the_profile():
    calibration = opened()
    assert play(calibration, "up", "up", "up", "repeat") == 30.0
    calibration.mark("sensory")
    play(calibration, *["up"] * 5)
    calibration.mark("motor")
    assert calibration.status().missing == ["comfort"]
    with pytest.raises(PlanError, match="not marked yet: comfort"):
        calibration.profile(NOON_S)
    play(calibration, *["up"] * 6, "down")
    calibration.mark("comfort")
    found = calibration.profile(NOON_S)
    assert (found.sensory_pulse_width_us, found.motor_pulse_width_us, found.max_pulse_width_us) == (30.0, 80.0, 130.0)
    check_profile(found, NOON_S + 60, required=True)
    assert len(calibration.recordings) == 16
    assert calibration.train(140.0).test_id == "c1.017"
    with pytest.raises(RefusedError, match="marked comfort maximum, over by 10"):
        calibration.next_width_us("up")


def test_never_above_the_request_the_rig_or_the_hard_limits():
    calibration = opened(max_pulse_width_us=45.0)
    play(calibration, *["up"] * 4)
    with pytest.raises(RefusedError, match=r"pulse_width_us 50 µs is outside 0 … 45 \(calibration request, over by 5"):
        calibration.next_width_us("up")
    heavy = opened(current_ma=100.0, step_us=25.0, train_s=0.1)
    play(heavy, *["up"] * 40)  # 10 µs each: no step adds more than 1 µC
    with pytest.raises(RefusedError, match="charge_per_phase_uc"):
        heavy.next_width_us("up")
    assert heavy.status().ceiling_us == pytest.approx(400.0)
    wide = opened(max_pulse_width_us=9999.0, step_us=25.0)
    assert wide.status().ceiling_us == 500.0
    table = limits.tightened(HARD_LIMITS, "pulse_width_us", 200.0, "rig file")
    request = CalibrateStartRequest(calibration_id="c", participant="P", by="t", max_pulse_width_us=300.0)
    assert Calibration(request, table, NOON_S).status().ceiling_owner == "rig file"


def test_the_dose_of_all_trains_together_is_limited():
    calibration = opened(current_ma=80.0, step_us=25.0, train_s=2.0)
    with pytest.raises(RefusedError, match="all trains together: charge_per_test_uc"):
        for _ in range(60):
            width_us = min(calibration._width_us + 25.0, 250.0)
            train = calibration.train(width_us)
            summary = {"charge_uc": 80 * width_us * 0.08, "pulses": 80}
            calibration.played(
                width_us, None, FinishedEvent(test_id=train.test_id, outcome="completed", summary=summary)
            )
    assert calibration._charge_uc <= 50_000


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"step_us": 26.0}, "calibration_step_us 26"),
        ({"step_us": math.nan}, "calibration_step_us nan"),
        ({"train_s": 3.0}, "calibration_train_s 3"),
        ({"current_ma": 101.0}, "current_ma 101"),
        ({"current_ma": 0.4}, "would stimulate nothing"),
        ({"current_ma": -1.0}, "current_ma -1"),
        ({"pulse_rate_hz": 61.0}, "pulse_rate_hz 61"),
        ({"max_pulse_width_us": math.nan}, "pulse_width_us nan"),
        ({"max_torque_nm": 0.0}, "max_torque_nm"),
        ({"train_s": 0.1, "pulse_rate_hz": 4.0}, "has no pulse"),
        ({"train_s": 0.4, "pulse_rate_hz": 1.0}, "has no pulse"),
        ({"train_s": math.nan}, "calibration_train_s nan"),
        ({"pulse_rate_hz": math.nan}, "pulse_rate_hz nan"),
        ({"current_ma": math.nan}, "current_ma nan"),
    ],
)
def test_a_calibration_outside_the_limits_is_refused(fields: dict[str, float], words: str):
    with pytest.raises(RefusedError, match=words):
        opened(**fields)


def test_what_a_coarse_stimulator_would_not_send_is_no_train():
    """A RehaStim 2 takes currents in steps of 2 mA and sends nothing below 20 µs."""
    coarse = Steps(1.0, 2.0, 20.0)
    request = CalibrateStartRequest(calibration_id="c1", participant="P01", by="t", current_ma=1.5)
    with pytest.raises(RefusedError, match=r"current_ma 1.5 mA would stimulate nothing; the smallest current is 2 mA"):
        Calibration(request, HARD_LIMITS, NOON_S, coarse)
    calibration = Calibration(request.model_copy(update={"current_ma": 10.0}), HARD_LIMITS, NOON_S, coarse)
    with pytest.raises(PlanError, match="step up instead"):
        calibration.next_width_us("repeat")
    assert play(calibration, "up", "up") == 30.0
    assert play(calibration, "down") == 20.0
    with pytest.raises(PlanError, match="no step below 20"):
        calibration.next_width_us("down")


def test_midnight_ends_an_open_calibration_and_says_so():
    calibration = opened()
    for threshold in ("sensory", "motor", "comfort"):
        play(calibration, "up")
        calibration.mark(threshold)
    midnight_s = end_of_day_s(NOON_S)
    calibration.check_day(midnight_s - 1)
    assert calibration.profile(midnight_s - 1).expires_at_utc == utc_text(midnight_s)
    for late in (calibration.check_day, calibration.profile):
        with pytest.raises(RefusedError, match="began on an earlier day"):
            late(midnight_s)


def test_a_test_that_would_outlast_its_profile_is_refused_at_its_start():
    calibrated = profile(expires_at_utc=utc_text(NOON_S + 30.0))
    check_profile(calibrated, NOON_S, required=True, duration_s=29.0)
    with pytest.raises(RefusedError, match="before the end of this test of 39 s"):
        check_profile(calibrated, NOON_S, required=True, duration_s=38.7)


def test_marks_keep_their_order():
    calibration = opened()
    with pytest.raises(PlanError, match="no train was played"):
        calibration.mark("sensory")
    with pytest.raises(PlanError, match="step up instead"):
        calibration.next_width_us("down")
    play(calibration, *["up"] * 5)
    calibration.mark("motor")
    play(calibration, "up")
    with pytest.raises(PlanError, match="sensory at 60 µs is above motor at 50 µs; mark motor again"):
        calibration.mark("sensory")
    calibration.mark("motor")
    calibration.mark("sensory")
    play(calibration, "down")
    with pytest.raises(PlanError, match="above comfort"):
        calibration.mark("comfort")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"expires_at_utc": utc_text(NOON_S - 1)}, "expired"),
        ({"set_at_utc": utc_text(NOON_S + 3000)}, "in the future"),
        ({"expires_at_utc": utc_text(NOON_S + 30 * 3600)}, "within one day"),
        ({"expires_at_utc": utc_text(NOON_S - 7200)}, "within one day"),
        ({"motor_pulse_width_us": 181.0}, "must be above 0"),
        ({"sensory_pulse_width_us": 120.0}, "must be above 0"),
        ({"sensory_pulse_width_us": 0.0}, "must be above 0"),
        ({"motor_pulse_width_us": math.nan}, "must be above 0"),
        ({"motor_pulse_width_us": None}, "incomplete"),
        ({"set_at_utc": None}, "incomplete"),
        ({"set_at_utc": "yesterday"}, "not a time in ISO 8601"),
        ({"set_at_utc": "2026-03-04T11:00:00"}, "time zone"),
    ],
)
def test_a_profile_that_is_wrong_or_old_is_refused(fields: dict[str, Any], words: str):
    check_profile(profile(), NOON_S, required=True)
    with pytest.raises(RefusedError, match=words):
        check_profile(profile(**fields), NOON_S, required=False)


def test_no_test_without_a_calibration_where_the_rig_asks_for_one():
    check_profile(Profile(), NOON_S, required=False)
    with pytest.raises(RefusedError, match="not calibrated"):
        check_profile(Profile(), NOON_S, required=True)


@pytest.mark.parametrize("hours", [0, 1, 11.99, 12, 23.9])
def test_the_day_ends_at_the_next_midnight_here(hours: float):
    now_s = NOON_S + hours * 3600
    end = datetime.fromtimestamp(end_of_day_s(now_s), UTC).astimezone()
    assert (end.hour, end.minute, end.second) == (0, 0, 0)
    assert 0 < end_of_day_s(now_s) - now_s <= 25 * 3600

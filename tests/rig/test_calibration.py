"""Guided calibration: its steps, never above a limit, thresholds in order, a profile that ends with the day."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stimrig.rig import limits, plan
from stimrig.rig.clock import utc_text
from stimrig.rig.control.calibration import ORDER, Calibration, check_profile, end_of_day_s
from stimrig.rig.devices.rehastim2 import RehaStim2
from stimrig.rig.errors import PlanError, RefusedError
from stimrig.rig.limits import HARD_LIMITS, Steps
from stimrig.rig.messages import FinishedEvent, Profile
from stimrig.rig.requests import CalibrateStartRequest

NOON_S = datetime(2026, 3, 4, 12, tzinfo=UTC).timestamp()


def opened(steps: Steps | None = None, **fields: Any) -> Calibration:
    request = CalibrateStartRequest(calibration_id="c1", participant="P01", by="therapist", **fields)
    return Calibration(request, HARD_LIMITS, NOON_S, steps or Steps())


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
            assert train.profile.max_pulse_width_us == width_us
            calibration.played(width_us, None, ended(80, charge_uc=80 * width_us * 0.08))
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


UP = "up"


def known(sensory: float = 60, motor: float = 100, comfort: float = 300, current_ma: float = 20) -> Profile:
    return Profile(
        current_ma=current_ma, max_pulse_width_us=comfort, sensory_pulse_width_us=sensory, motor_pulse_width_us=motor
    )


def stepped(steps: Steps | None = None, **fields: Any) -> Calibration:
    return opened(steps, **{"large_steps": True, **fields})


def widths(calibration: Calibration) -> list[float]:
    return [train.pulse_width_us for train in calibration.status().trains]


def climb(calibration: Calibration, until_us: dict[str, float]) -> list[float]:
    for threshold in ORDER:
        while calibration.status().pulse_width_us < until_us[threshold]:
            play(calibration, UP)
        calibration.mark(threshold)
    return widths(calibration)


def test_a_known_participant_begins_below_the_last_mark_and_slows_down_near_the_comfort_maximum() -> None:
    found = climb(stepped(last=known()), {"sensory": 60, "motor": 100, "comfort": 300})
    assert found == [36, 60, 100, 140, 180, 220, 260, 290, 300]


def test_past_the_last_comfort_maximum_every_step_is_a_fine_one() -> None:
    found = climb(stepped(last=known(), step_us=7.0), {"sensory": 60, "motor": 100, "comfort": 330})
    past = [width for width in found if width >= 293]
    assert past == [293, 300, 307, 314, 321, 328, 335]


def test_a_step_back_goes_half_the_way_and_so_does_the_step_after_it() -> None:
    calibration = stepped()
    assert play(calibration, UP, UP, UP) == 75
    assert play(calibration, "down") == 62, "what the stimulator sends for 62.5"
    assert play(calibration, UP) == 72
    assert play(calibration, UP) == 75
    assert play(calibration, UP) == 100, "no narrower than before is left to look at"
    assert play(calibration, "down") == 87
    calibration.mark("sensory")
    assert play(calibration, UP) == 112, "the answer was given; on to the next one"


def test_marks_of_a_smaller_current_are_not_used() -> None:
    assert stepped(last=known(current_ma=19.5)).status().last_us == {}
    assert stepped(last=known(current_ma=20)).status().last_us == {"sensory": 60, "motor": 100, "comfort": 300}
    assert stepped(last=known(current_ma=19.5)).next_width_us(UP) == 25


def test_the_first_train_is_never_a_strong_one() -> None:
    assert stepped(last=known(sensory=300, motor=300)).next_width_us(UP) == 100
    assert stepped(last=known(sensory=300, motor=300, current_ma=100), current_ma=100.0).next_width_us(UP) == 20
    assert stepped(current_ma=100.0).next_width_us(UP) == 10


def test_the_bound_counts_what_is_sent_with_the_current_rounded_toward_zero() -> None:
    for current_ma in (50, 51, 51.9):
        assert stepped(RehaStim2.steps, current_ma=current_ma).next_width_us("up") == 20
    with pytest.raises(RefusedError, match=r"at 52 mA .* is 1.04 µC"):
        stepped(RehaStim2.steps, current_ma=52)


def test_who_felt_more_last_time_may_begin_with_it() -> None:
    """60 % of the last sensory threshold, at most 2 µC; narrower than the shortest pulse is no beginning."""

    def knowing(current_ma: float, felt_us: float) -> Calibration:
        last = known(felt_us, felt_us, comfort=500, current_ma=100)
        return stepped(RehaStim2.steps, current_ma=current_ma, last=last)

    assert knowing(80, 40).next_width_us("up") == 24
    assert knowing(100, 200).next_width_us("up") == 20
    with pytest.raises(RefusedError, match="choose 50 mA or less"):
        knowing(80, 30)


@pytest.mark.parametrize(
    "last",
    [
        known(sensory=math.nan), known(motor=math.nan), known(comfort=math.nan), known(comfort=math.inf),
        known(sensory=0), known(sensory=-5), known(sensory=120), known(motor=400), known(current_ma=math.nan),
        known(current_ma=-20), known(current_ma=0),
    ],
)  # fmt: skip
def test_marks_that_make_no_sense_are_refused(last: Profile) -> None:
    with pytest.raises(RefusedError, match="marks of the earlier calibration"):
        stepped(last=last)


def test_another_width_than_the_one_shown_is_not_sent() -> None:
    calibration = stepped(last=known())
    calibration.check_shown(calibration.next_width_us(UP), 36.0)
    calibration.check_shown(36.9, 36.0)  # what is sent is rounded toward zero
    for shown_us in (35.0, 37.0, math.nan):
        with pytest.raises(PlanError, match="nothing was sent"):
            calibration.check_shown(36.0, shown_us)


def ended(pulses: int, **more: Any) -> FinishedEvent:
    return FinishedEvent(test_id="c1.002", outcome="completed", summary={"pulses": pulses, **more})


BROKEN = ended(9, pauses=[{"for_s": 0.6}])


def test_a_train_that_was_not_felt_whole_marks_nothing() -> None:
    """Nor does a step go on from it: nobody knows what its width feels like."""
    calibration = stepped()
    assert play(calibration, UP) == 25
    calibration.played(calibration.next_width_us(UP), 0.0, BROKEN)
    with pytest.raises(PlanError, match="train 2 was not sent whole"):
        calibration.mark("sensory")
    assert (calibration.status().pulse_width_us, calibration.next_width_us(UP)) == (25, 50)
    assert play(calibration, UP) == 50
    calibration.mark("sensory")
    for missed, marked in ((1, True), (4, False)):
        calibration.played(75.0, 0.0, ended(16, dropped_pulses=missed))
        if marked:
            calibration.mark("motor")
        else:
            with pytest.raises(PlanError, match="not sent whole"):
                calibration.mark("motor")


def test_who_steps_down_is_never_taken_back_up_by_a_pause() -> None:
    calibration = stepped()
    assert play(calibration, UP, UP, UP) == 75
    down_us = calibration.next_width_us("down")
    calibration.played(down_us, 0.0, BROKEN)
    assert calibration.next_width_us("repeat") == down_us < 75


def test_a_train_of_which_nothing_was_sent_moves_nothing() -> None:
    """Each step is one from the last train that was felt, however many were dropped in between."""
    calibration = stepped()
    nothing = ended(0, dropped_pulses=4)
    calibration.played(calibration.next_width_us(UP), 0.0, nothing)
    assert (calibration.status().pulse_width_us, calibration.next_width_us(UP)) == (0, 25)
    assert play(calibration, UP, UP) == 50
    for _ in range(3):
        assert calibration.next_width_us(UP) == 75
        calibration.played(75.0, 0.0, nothing)
    with pytest.raises(PlanError, match="train 6 was not sent whole"):
        calibration.mark("sensory")
    calibration.played(calibration.next_width_us("down"), 0.0, nothing)
    assert play(calibration, UP) == 75, "nobody stepped back from it"
    calibration.mark("sensory")
    assert calibration.train(100.0).test_id == "c1.009"


plausible = st.floats(1, 500)
actions = st.lists(
    st.sampled_from(["up", "up", "up", "fine", "repeat", "down", "sensory", "motor", "comfort"]), max_size=60
)


@settings(max_examples=150, deadline=None)
@given(
    st.floats(0.5, 100), st.floats(1, 25), st.lists(plausible, min_size=3, max_size=3), st.floats(0.5, 130),
    st.booleans(), st.one_of(st.none(), st.floats(1, 500)), st.sampled_from([1.0, 20.0]), actions,
)  # fmt: skip
def test_whatever_is_pressed(
    current_ma: float, step_us: float, marks: list[float], last_ma: float, is_known: bool, most_us: float | None,
    shortest_us: float, pressed: list[str],
) -> None:  # fmt: skip
    """Never above the ceiling, never more than the largest increase, marks in order, and what is told is sent."""
    device = Steps(shortest_us=shortest_us)
    last = known(*sorted(marks), current_ma=last_ma) if is_known else None
    try:
        calibration = stepped(device, current_ma=current_ma, step_us=step_us, last=last, max_pulse_width_us=most_us)
    except RefusedError:
        assert shortest_us * device.current(current_ma) * 1e-3 > 1
        return
    now_us = 0.0
    for action in pressed:
        if action in ORDER:
            try:
                calibration.mark(action)
            except PlanError:
                continue
            marked = [calibration.status().marks_us.get(name) for name in ORDER]
            assert (known_us := [mark for mark in marked if mark is not None]) == sorted(known_us)
            continue
        told = calibration.status()
        try:
            width_us = calibration.next_width_us(action)
        except (PlanError, RefusedError):
            assert action not in told.next_us
            continue
        assert told.next_us[action] == device.width_us(width_us) >= shortest_us
        assert width_us <= told.ceiling_us <= (most_us or 500)
        charge_uc = current_ma * 1e-3
        if now_us:
            assert width_us - now_us <= 40 + 1e-9 and (width_us - now_us) * charge_uc <= 1 + 1e-9
            if not told.last_us or width_us > told.last_us["comfort"]:
                assert width_us - now_us <= 25 + 1e-9
        else:
            sent_uc = width_us * device.current(current_ma) * 1e-3
            assert sent_uc <= (2 if told.last_us else 1) + 1e-9
            assert not told.last_us or width_us <= max(shortest_us, step_us, 0.6 * told.last_us["sensory"]) + 1e-9
        assert (action == "down") == (width_us < now_us) and (action == "repeat") == (width_us == now_us)
        calibration.played(width_us, 0.1, ended(20))
        now_us = width_us


def test_fine_is_fine_wherever() -> None:
    calibration = stepped(last=known())
    play(calibration, UP)
    assert calibration.next_width_us("fine") == 46
    assert stepped(last=known()).next_width_us("fine") == 10
    strong = stepped(step_us=25.0, current_ma=100.0)
    assert strong.next_width_us("fine") == strong.status().step_us == 10, "and the step that is told is the one taken"

"""Large steps that become fine near a mark: what they are, and what they never are."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stimrig.rig.control.calibration import ORDER, Calibration
from stimrig.rig.devices.p24 import P24
from stimrig.rig.devices.rehastim2 import RehaStim2
from stimrig.rig.errors import PlanError, RefusedError
from stimrig.rig.limits import HARD_LIMITS, Steps
from stimrig.rig.messages import CalibrateStartRequest, FinishedEvent, Profile
from tests.rig.test_calibration import NOON_S, play

UP = "up"


def known(sensory: float = 60, motor: float = 100, comfort: float = 300, current_ma: float = 20) -> Profile:
    return Profile(
        current_ma=current_ma, max_pulse_width_us=comfort, sensory_pulse_width_us=sensory, motor_pulse_width_us=motor
    )


def opened(steps: Steps | None = None, **fields: Any) -> Calibration:
    request = CalibrateStartRequest(
        **{"calibration_id": "c1", "participant": "P01", "by": "t", "large_steps": True, **fields}
    )
    return Calibration(request, HARD_LIMITS, NOON_S, steps or Steps())


def widths(calibration: Calibration) -> list[float]:
    return [train.pulse_width_us for train in calibration.status().trains]


def climb(calibration: Calibration, until_us: dict[str, float]) -> list[float]:
    """A participant who answers: mark each threshold at the first train that reaches it."""
    for threshold in ORDER:
        while calibration.status().pulse_width_us < until_us[threshold]:
            play(calibration, UP)
        calibration.mark(threshold)
    return widths(calibration)


def test_a_new_participant_gets_large_steps_from_the_first_on() -> None:
    assert climb(opened(), {"sensory": 60, "motor": 100, "comfort": 300}) == [25.0 * n for n in range(1, 13)]


def test_a_known_participant_begins_below_the_last_mark_and_slows_down_near_the_comfort_maximum() -> None:
    found = climb(opened(last=known()), {"sensory": 60, "motor": 100, "comfort": 300})
    assert found == [36, 60, 100, 140, 180, 220, 260, 290, 300]


@pytest.mark.parametrize(
    ("today", "trains"),
    [
        ({"sensory": 50, "motor": 90, "comfort": 280}, 8),
        ({"sensory": 66, "motor": 108, "comfort": 300}, 11),
        ({"sensory": 60, "motor": 100, "comfort": 320}, 11),
        ({"sensory": 120, "motor": 180, "comfort": 300}, 13),
    ],
)
def test_other_thresholds_than_last_time_are_found_too(today: dict[str, float], trains: int) -> None:
    calibration = opened(last=known())
    assert len(climb(calibration, today)) == trains
    marks = calibration.status().marks_us
    assert all(today[name] <= marks[name] < today[name] + 40 for name in ORDER)


def test_past_the_last_comfort_maximum_every_step_is_a_fine_one() -> None:
    calibration = opened(last=known(), step_us=7.0)
    climb(calibration, {"sensory": 60, "motor": 100, "comfort": 260})
    calibration = opened(last=known(), step_us=7.0)
    found = climb(calibration, {"sensory": 60, "motor": 100, "comfort": 330})
    past = [width for width in found if width >= 293]
    assert past == [293, 300, 307, 314, 321, 328, 335]


def test_a_step_back_goes_half_the_way_and_so_does_the_step_after_it() -> None:
    calibration = opened()
    assert play(calibration, UP, UP, UP) == 75
    assert play(calibration, "down") == 62, "what the stimulator sends for 62.5"
    assert play(calibration, UP) == 72
    assert play(calibration, UP) == 75
    assert play(calibration, UP) == 100, "no narrower than before is left to look at"
    assert play(calibration, "down") == 87
    calibration.mark("sensory")
    assert play(calibration, UP) == 112, "the answer was given; on to the next one"


def test_fine_is_fine_wherever() -> None:
    calibration = opened(last=known())
    play(calibration, UP)
    assert calibration.next_width_us("fine") == 46
    assert opened(last=known()).next_width_us("fine") == 10
    strong = opened(step_us=25.0, current_ma=100.0)
    assert strong.next_width_us("fine") == strong.status().step_us == 10, "and the step that is told is the one taken"


def test_marks_of_a_smaller_current_are_not_used() -> None:
    assert opened(last=known(current_ma=19.5)).status().last_us == {}
    assert opened(last=known(current_ma=20)).status().last_us == {"sensory": 60, "motor": 100, "comfort": 300}
    assert opened(last=known(current_ma=19.5)).next_width_us(UP) == 25


def test_the_first_train_is_never_a_strong_one() -> None:
    assert opened(last=known(sensory=300, motor=300)).next_width_us(UP) == 100
    assert opened(last=known(sensory=300, motor=300, current_ma=100), current_ma=100.0).next_width_us(UP) == 20
    assert opened(current_ma=100.0).next_width_us(UP) == 10


def test_the_last_step_up_ends_at_the_ceiling_and_no_other_follows() -> None:
    calibration = opened(max_pulse_width_us=60.0)
    assert play(calibration, UP, UP, UP) == 60
    with pytest.raises(RefusedError, match="calibration request, over by 25"):
        calibration.next_width_us(UP)
    assert "up" not in calibration.status().next_us
    play(calibration, "down")
    calibration.mark("comfort")
    play(calibration, "down", UP)
    with pytest.raises(RefusedError, match="marked comfort maximum"):
        play(calibration, UP, UP)
    assert widths(calibration)[-1] == calibration.status().marks_us["comfort"]


@pytest.mark.parametrize("large", [True, False])
def test_a_current_whose_shortest_pulse_is_too_strong_is_refused_with_the_one_to_choose(large: bool) -> None:
    with pytest.raises(RefusedError) as caught:
        opened(RehaStim2.steps, current_ma=80, large_steps=large)
    assert str(caught.value) == (
        "calibration: at 80 mA the stimulator's shortest pulse, 20 µs, is 1.6 µC, too strong for a first train; "
        "choose 50 mA or less"
    )
    assert opened(P24.steps, current_ma=80, large_steps=large).next_width_us("up") <= 12


def test_the_bound_counts_what_is_sent_with_the_current_rounded_toward_zero() -> None:
    for current_ma in (50, 51, 51.9):
        assert opened(RehaStim2.steps, current_ma=current_ma).next_width_us("up") == 20
    with pytest.raises(RefusedError, match=r"at 52 mA .* is 1.04 µC"):
        opened(RehaStim2.steps, current_ma=52)


def test_who_felt_more_last_time_may_begin_with_it() -> None:
    """60 % of the last sensory threshold, at most 2 µC; narrower than the shortest pulse is no beginning."""

    def knowing(current_ma: float, felt_us: float) -> Calibration:
        last = known(felt_us, felt_us, comfort=500, current_ma=100)
        return opened(RehaStim2.steps, current_ma=current_ma, last=last)

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
        opened(last=last)


def test_another_width_than_the_one_shown_is_not_sent() -> None:
    calibration = opened(last=known())
    calibration.check_shown(calibration.next_width_us(UP), 36.0)
    calibration.check_shown(36.9, 36.0)  # what is sent is rounded toward zero
    for shown_us in (35.0, 37.0, math.nan):
        with pytest.raises(PlanError, match="nothing was sent"):
            calibration.check_shown(36.0, shown_us)


def test_a_train_of_which_nothing_was_sent_moves_nothing() -> None:
    """Each step is one from the last train that was felt, however many were dropped in between."""
    calibration = opened()
    nothing = FinishedEvent(test_id="c1.001", outcome="completed", summary={"pulses": 0, "dropped_pulses": 4})
    calibration.played(calibration.next_width_us(UP), 0.0, nothing)
    assert (calibration.status().pulse_width_us, calibration.next_width_us(UP)) == (0, 25)
    assert play(calibration, UP, UP) == 50
    for _ in range(3):
        assert calibration.next_width_us(UP) == 75
        calibration.played(75.0, 0.0, nothing)
    with pytest.raises(PlanError, match="no pulse of train 6 was sent"):
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
        calibration = opened(device, current_ma=current_ma, step_us=step_us, last=last, max_pulse_width_us=most_us)
    except RefusedError:
        assert shortest_us * device.current(current_ma) * 1e-3 > 1
        return
    now_us = 0.0
    for action in pressed:
        if action in ORDER:
            try:
                calibration.mark(action)  # pyright: ignore[reportArgumentType]
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
        assert told.next_us[action] == device.width_us(width_us) >= shortest_us  # pyright: ignore[reportArgumentType]
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
        calibration.played(width_us, 0.1, FinishedEvent(test_id="t", outcome="completed", summary={"pulses": 20}))
        now_us = width_us

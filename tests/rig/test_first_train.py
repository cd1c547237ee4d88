"""The first train of a calibration is within its bound on every stimulator, or there is none."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.control.calibration import Calibration
from rig.devices.p24 import P24
from rig.devices.rehastim2 import RehaStim2
from rig.errors import PlanError, RefusedError
from rig.limits import HARD_LIMITS, Steps
from rig.messages import CalibrateStartRequest, Profile
from tests.rig.test_calibration import NOON_S

REHASTIM, FINE = RehaStim2.steps, P24.steps


def opened(
    current_ma: float, steps: Steps = REHASTIM, *, sensory_us: float = 0, large: bool = True, step_us: float = 5
):
    last = None
    if sensory_us:
        last = Profile(
            current_ma=100, max_pulse_width_us=500, sensory_pulse_width_us=sensory_us, motor_pulse_width_us=sensory_us
        )
    request = CalibrateStartRequest(
        calibration_id="c1", participant="P01", by="t", large_steps=large, last=last, current_ma=current_ma,
        step_us=step_us,
    )  # fmt: skip
    return Calibration(request, HARD_LIMITS, NOON_S, steps)


@pytest.mark.parametrize("large", [True, False])
def test_a_current_whose_shortest_pulse_is_too_strong_is_refused_with_the_one_to_choose(large: bool) -> None:
    with pytest.raises(RefusedError) as caught:
        opened(80, large=large)
    assert str(caught.value) == (
        "calibration: at 80 mA the stimulator's shortest pulse, 20 µs, is 1.6 µC, too strong for a first train; "
        "choose 50 mA or less"
    )
    assert opened(80, FINE, large=large).next_width_us("up") <= 12


def test_the_bound_counts_what_is_sent_with_the_current_rounded_toward_zero() -> None:
    for current_ma in (50, 51, 51.9):
        assert opened(current_ma).next_width_us("up") == 20
    with pytest.raises(RefusedError, match=r"at 52 mA .* is 1.04 µC"):
        opened(52)


def test_who_felt_more_last_time_may_begin_with_it() -> None:
    """60 % of the last sensory threshold, at most 2 µC; narrower than the shortest pulse is no beginning."""
    assert opened(80, sensory_us=40).next_width_us("up") == 24
    assert opened(100, sensory_us=200).next_width_us("up") == 20
    with pytest.raises(RefusedError, match="choose 50 mA or less"):
        opened(80, sensory_us=30)


@settings(max_examples=300, deadline=None)
@given(
    st.floats(2, 100), st.sampled_from([REHASTIM, FINE]), st.floats(0, 400), st.booleans(), st.floats(1, 25),
    st.sampled_from(["up", "fine", "repeat", "down"]),
)  # fmt: skip
def test_no_first_train_is_above_its_bound(
    current_ma: float, steps: Steps, sensory_us: float, large: bool, step_us: float, direction: str
) -> None:
    try:
        calibration = opened(current_ma, steps, sensory_us=sensory_us, large=large, step_us=step_us)
        width_us = calibration.next_width_us(direction)
    except (PlanError, RefusedError):
        return
    charge_uc = width_us * steps.current(current_ma) * 1e-3
    felt_uc = 0.6 * sensory_us * current_ma * 1e-3 if large else 0.0
    assert charge_uc <= max(1.0, min(2.0, felt_uc)) + 1e-9

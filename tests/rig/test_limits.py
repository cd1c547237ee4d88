"""Limits: whatever is asked, nothing outside the bounds comes out."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig import limits
from rig.errors import RefusedError
from rig.limits import HARD_LIMITS, Admitted, Refusal, admit
from rig.messages import Profile
from rig.signals import Pulse

anything = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(-10, 600),
    st.sampled_from([0.0, -0.0, math.nan, math.inf, -math.inf, 1e308, -1e-320, 300.0, 300.0000001, 299.9999999]),
)


@settings(max_examples=5000, deadline=None)
@given(anything, anything, st.floats(0, 500), st.floats(0, 100))
def test_no_pulse_outside_passes(width_us: float, current_ma: float, most_us: float, most_ma: float):
    profile = Profile(current_ma=most_ma, max_pulse_width_us=most_us)
    table = limits.for_profile(HARD_LIMITS, profile)
    verdict = admit(Pulse(width_us, current_ma), table)
    if isinstance(verdict, Admitted):
        assert 0 <= verdict.pulse_width_us <= min(most_us, 500)
        assert 0 <= verdict.current_ma <= min(most_ma, 100)
        assert verdict.charge_uc <= 40.0
        assert verdict.pulse_width_us <= width_us  # toward zero
        assert verdict.current_ma <= current_ma
        assert isinstance(verdict.pulse_width_us, int)
        assert (2 * verdict.current_ma).is_integer()
    else:
        assert verdict.reason


def test_rounding_is_toward_zero():
    assert admit(Pulse(299.999, 20.49), HARD_LIMITS) == Admitted(299, 20.0)
    assert admit(Pulse(0.9, 0.4), HARD_LIMITS) == Admitted(0, 0.0)


@pytest.mark.parametrize(
    ("pulse", "limit"),
    [
        (Pulse(500.5, 20), "pulse_width_us"),
        (Pulse(-1, 20), "pulse_width_us"),
        (Pulse(math.nan, 20), "pulse_width_us"),
        (Pulse(100, 100.5), "current_ma"),
        (Pulse(100, math.nan), "current_ma"),
        (Pulse(500, 81), "charge_per_phase_uc"),
    ],
)
def test_refusal_names_the_limit(pulse: Pulse, limit: str):
    verdict = admit(pulse, HARD_LIMITS)
    assert isinstance(verdict, Refusal)
    assert verdict.limit == limit


def test_refusal_says_whose_limit_and_by_how_much():
    table = limits.for_profile(HARD_LIMITS, Profile(max_pulse_width_us=250))
    words = str(admit(Pulse(260, 20), table))
    assert "participant's profile" in words
    assert "over by 10" in words
    assert "250" in words


def test_a_profile_tightens_and_never_widens():
    table = limits.for_profile(HARD_LIMITS, Profile(max_pulse_width_us=9999, current_ma=9999, max_torque_nm=9999))
    assert table["pulse_width_us"].hi == 500
    assert table["current_ma"].hi == 100
    assert table["torque_nm"].hi == 60
    assert limits.for_profile(HARD_LIMITS, Profile(max_torque_nm=5))["torque_nm"].lo == -5


@pytest.mark.parametrize("field", ["max_pulse_width_us", "current_ma", "max_torque_nm"])
@pytest.mark.parametrize("value", [math.nan, -1.0])
def test_a_profile_of_nonsense_is_refused(field: str, value: float):
    with pytest.raises(RefusedError, match="profile"):
        limits.for_profile(HARD_LIMITS, Profile(**{field: value}))


def test_every_limit_has_its_reason_and_source():
    for name, row in HARD_LIMITS.items():
        assert row.name == name
        assert row.reason
        assert row.source
        assert row.lo < row.hi

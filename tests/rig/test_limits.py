"""Limits: whatever is asked, nothing outside the bounds comes out."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig import limits
from rig.errors import RefusedError
from rig.limits import HARD_LIMITS, Admitted, Refusal, admit
from rig.messages import Profile, Status, TestPlan
from rig.signals import Pulse
from tests.harness.limits_fuzz import fuzz, fuzz_plans

anything = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(-10, 600),
    st.sampled_from([0.0, -0.0, math.nan, math.inf, -math.inf, 1e308, -1e-320, 300.0, 300.0000001, 299.9999999]),
)


@settings(max_examples=2000, deadline=None)
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


def test_mad_requests_at_the_gate_are_not_felt():
    """On a seed of its own, through both drivers; `python -m bench.rig_fuzz` makes a million on others."""
    found = fuzz(100_000, seed=20)
    assert found.outside == 0, found.example
    assert found.felt == found.sent > 10_000  # it is no wall
    assert found.refused_profiles > 10


def test_no_mad_plan_is_admitted_with_anything_outside():
    found = fuzz_plans(2000, seed=20)
    assert found.outside == 0, found.example
    assert found.sent > 50
    assert found.refused_profiles > 200


@pytest.mark.parametrize("name", sorted({r.name for r in HARD_LIMITS.values()}))
def test_each_row_refuses_just_beside_its_bounds_and_says_by_how_much(name: str):
    row = HARD_LIMITS[name]
    for bound, beside in ((row.hi, math.inf), (row.lo, -math.inf)):
        if math.isfinite(bound):
            assert limits.check(row, bound) is None
            assert limits.check(row, math.nextafter(bound, beside)) is not None
            words = str(limits.check(row, bound + math.copysign(1.0, beside)))
            assert f"{name} " in words
            assert ("over by 1" if beside > 0 else "under by 1") in words
            assert "hard limit" in words
    for nonsense in (math.nan, math.inf if math.isfinite(row.hi) else math.nan):
        assert limits.check(row, nonsense) is not None


def request(profile: Profile, **fields: float) -> TestPlan:
    return TestPlan(test_id="t", participant="P", profile=profile, **fields)


def test_of_hard_limit_rig_file_profile_and_request_the_tightest_wins():
    file = limits.tightened(HARD_LIMITS, "pulse_width_us", 250.0, "rig file")
    for profile_us, request_us, owner, most_us in (
        (300.0, None, "rig file", 250.0),
        (200.0, None, "participant's profile", 200.0),
        (200.0, 150.0, "request", 150.0),
        (200.0, 400.0, "participant's profile", 200.0),
    ):
        plan = request(
            Profile(max_pulse_width_us=profile_us), **({"max_pulse_width_us": request_us} if request_us else {})
        )
        row = limits.for_plan(file, plan)["pulse_width_us"]
        assert (row.owner, row.hi) == (owner, most_us)
        assert owner in str(limits.check(row, most_us + 3))
        assert "over by 3" in str(limits.check(row, most_us + 3))
    tight = limits.for_plan(HARD_LIMITS, request(Profile(rest_between_tests_s=60), max_torque_nm=7))
    assert (tight["torque_nm"].lo, tight["torque_nm"].hi, tight["torque_nm"].owner) == (-7, 7, "request")
    assert "under by 50" in str(limits.check(tight["rest_between_tests_s"], 10.0))
    for wrong in ({"max_torque_nm": math.nan}, {"max_torque_nm": -1.0}, {"max_pulse_width_us": math.nan}):
        with pytest.raises(RefusedError, match="request"):
            limits.for_plan(HARD_LIMITS, request(Profile(), **wrong))
    with pytest.raises(RefusedError, match="rest_between_tests_s"):
        limits.for_plan(HARD_LIMITS, request(Profile(rest_between_tests_s=math.nan)))


def test_clients_are_told_the_bounds_of_this_rig():
    """Finite numbers or none, so that they pass through JSON; whose bound it is beside each."""
    table = limits.tightened(HARD_LIMITS, "current_ma", 60.0, "rig file")
    told = limits.bounds(table)
    assert set(told) == set(HARD_LIMITS)
    assert (told["current_ma"].hi, told["current_ma"].owner) == (60.0, "rig file")
    assert (told["pulse_width_us"].hi, told["pulse_width_us"].owner) == (500.0, "hard limit")
    assert told["width_rise_us"].lo is None and told["rest_between_tests_s"].hi is None
    status = Status(state="ready", limits=told)
    assert Status.model_validate_json(status.model_dump_json()) == status

"""Limits: whatever is asked, nothing outside the bounds comes out."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stimrig.rig import limits
from stimrig.rig.errors import RefusedError
from stimrig.rig.limits import HARD_LIMITS, Admitted, Refusal, admit
from stimrig.rig.messages import PASSIVE, AdaptivePlan, AnglePlan, Profile, Status, TestPlan
from stimrig.rig.signals import Pulse

anything = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(-10, 600),
    st.sampled_from([0.0, -0.0, math.nan, math.inf, -math.inf, 1e308, -1e-320, 300.0, 300.0000001, 299.9999999]),
)


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(anything, anything, st.floats(0, 500), st.floats(0, 100))
def test_no_pulse_outside_passes(width_us: float, current_ma: float, most_us: float, most_ma: float):
    profile = Profile(current_ma=most_ma, max_pulse_width_us=most_us)
    table = limits.for_profile(HARD_LIMITS, profile)
    verdict = admit(Pulse(width_us, current_ma), table)
    inside = 0 <= width_us <= most_us and 0 <= current_ma <= most_ma and width_us * current_ma * 1e-3 <= 40.0
    assert isinstance(verdict, Admitted) == inside
    if isinstance(verdict, Admitted):
        assert 0 <= verdict.pulse_width_us <= min(most_us, 500)
        assert 0 <= verdict.current_ma <= min(most_ma, 100)
        assert verdict.charge_uc <= 40.0
        assert verdict.pulse_width_us <= width_us  # toward zero
        assert verdict.current_ma <= current_ma
        assert isinstance(verdict.pulse_width_us, int)
        assert (2 * verdict.current_ma).is_integer()
    else:
        assert verdict.limit.reason


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
    assert verdict.limit.name == limit


@pytest.mark.parametrize("field", ["max_pulse_width_us", "current_ma", "max_torque_nm"])
@pytest.mark.parametrize("value", [math.nan, -1.0])
def test_a_profile_of_nonsense_is_refused(field: str, value: float):
    with pytest.raises(RefusedError, match="profile"):
        limits.for_profile(HARD_LIMITS, Profile(**{field: value}))


def test_the_hard_limits_are_those_that_were_agreed_on():
    """Written down a second time on purpose: nobody changes a limit without changing it here, too."""
    inf = math.inf
    assert {name: (row.lo, row.hi, row.unit, row.owner) for name, row in HARD_LIMITS.items()} == {
        name: (lo, hi, unit, "hard limit")
        for name, lo, hi, unit in (
            ("pulse_width_us", 0, 500, "µs"),
            ("current_ma", 0, 100, "mA"),
            ("charge_per_phase_uc", 0, 40, "µC"),
            ("charge_per_second_uc", 0, 1600, "µC/s"),
            ("pulse_rate_hz", 1, 60, "Hz"),
            ("pulse_interval_s", 0.008, inf, "s"),
            ("torque_nm", -60, 60, "N·m"),
            ("torque_jump_nm", 0, 5, "N·m"),
            ("angle_rad", -0.35, 2.79, "rad"),
            ("angle_jump_rad", 0, 0.12, "rad"),
            ("duration_s", 0, 300, "s"),
            ("charge_per_test_uc", 0, 50_000, "µC"),
            ("width_rise_us", -inf, 50, "µs/pulse"),
            ("rest_between_tests_s", 1, inf, "s"),
            ("rest_between_trains_s", 0.5, inf, "s"),
            ("calibration_step_us", 1, 25, "µs"),
            ("calibration_known_step_us", 1, 40, "µs"),
            ("calibration_rise_uc", 0, 1, "µC"),
            ("calibration_first_uc", 0, 2, "µC"),
            ("calibration_train_s", 0.1, 2, "s"),
        )
    }


def test_the_strongest_admitted_pulses_stay_below_the_stimulators_standard():
    """IEC 60601-2-10, 201.12.4 into 500 Ω, and its attention level of current density on electrodes of 10 cm²."""
    load_ohm, area_cm2 = 500.0, 10.0
    pulses = [Pulse(width, current) for width in range(10, 501, 10) for current in range(2, 101, 2)]
    admitted = [verdict for pulse in pulses if isinstance(verdict := admit(pulse, HARD_LIMITS), Admitted)]
    rate, charge = HARD_LIMITS["pulse_rate_hz"].hi, HARD_LIMITS["charge_per_second_uc"].hi
    energy_mj = max(2 * load_ohm * (p.current_ma * 1e-3) ** 2 * p.pulse_width_us * 1e-3 for p in admitted)
    rms_ma = max(
        p.current_ma * math.sqrt(2 * p.pulse_width_us * 1e-6 * min(rate, charge / p.charge_uc)) for p in admitted
    )
    assert len(admitted) > 100 and energy_mj < 300
    assert rms_ma < 50 and rms_ma / area_cm2 < 2
    assert rate < 400


def test_a_limit_cannot_be_changed_in_place():
    for thing, name in (
        (HARD_LIMITS["current_ma"], "hi"),
        (limits.FINEST, "shortest_us"),
        (Admitted(100, 20.0), "current_ma"),
        (limits.check(HARD_LIMITS["current_ma"], 101), "value"),
    ):
        with pytest.raises(FrozenInstanceError):
            setattr(thing, name, 1e9)


def test_a_narrowed_row_differs_in_its_bounds_and_its_owner_alone():
    for name, narrow, changed in (
        ("current_ma", lambda: limits.tightened(HARD_LIMITS, "current_ma", 60.0, "rig file"), {"hi": 60.0}),
        ("current_ma", lambda: limits.tightened(HARD_LIMITS, "current_ma", 0.0, "rig file"), {"hi": 0.0}),
        (
            "torque_nm",
            lambda: limits.tightened(HARD_LIMITS, "torque_nm", 99.0, "rig file", lo=-7.0),
            {"lo": -7.0, "hi": 60.0},
        ),
        (
            "rest_between_tests_s",
            lambda: limits.at_least(HARD_LIMITS, "rest_between_tests_s", 9, "rig file"),
            {"lo": 9},
        ),
        ("pulse_rate_hz", lambda: limits.at_least(HARD_LIMITS, "pulse_rate_hz", 60.0, "rig file"), {"lo": 60.0}),
    ):
        row = replace(HARD_LIMITS[name], owner="rig file", **changed)
        assert narrow() == {**HARD_LIMITS, name: row}


def test_a_bound_no_tighter_than_what_holds_changes_nothing_not_even_the_owner():
    for hi, lo in ((60.0, None), (60.0, -60.0), (99.0, -99.0)):
        assert limits.tightened(HARD_LIMITS, "torque_nm", hi, "rig file", lo) == HARD_LIMITS
    for lo in (1.0, 0.5, -math.inf):
        assert limits.at_least(HARD_LIMITS, "rest_between_tests_s", lo, "rig file") == HARD_LIMITS


def test_a_bound_that_leaves_nothing_is_refused_and_says_what_would_do():
    for narrow, words in (
        (
            lambda: limits.tightened(HARD_LIMITS, "pulse_rate_hz", 0.5, "rig file"),
            "rig file: pulse_rate_hz 0.5 Hz must be at least 1 Hz",
        ),
        (
            lambda: limits.at_least(HARD_LIMITS, "pulse_rate_hz", 61, "rig file"),
            "rig file: pulse_rate_hz 61 Hz must be at most 60 Hz",
        ),
        (
            lambda: limits.for_profile(HARD_LIMITS, Profile(max_torque_nm=0.0)),
            "participant's profile: max_torque_nm 0 N·m must be above 0",
        ),
        (
            lambda: limits.for_plan(HARD_LIMITS, request(Profile(), max_torque_nm=0.0)),
            "request: max_torque_nm 0 N·m must be above 0",
        ),
    ):
        with pytest.raises(RefusedError) as raised:
            narrow()
        assert str(raised.value) == words
    whole = Profile(max_pulse_width_us=250, current_ma=15, max_torque_nm=9, rest_between_tests_s=30)
    narrowed = limits.for_profile(HARD_LIMITS, whole)
    assert {name: row.owner for name, row in narrowed.items() if row != HARD_LIMITS[name]} == dict.fromkeys(
        ("pulse_width_us", "current_ma", "torque_nm", "rest_between_tests_s"), "participant's profile"
    )
    assert (narrowed["current_ma"].hi, narrowed["torque_nm"].lo, narrowed["torque_nm"].hi) == (15, -9, 9)
    gentle = limits.for_plan(HARD_LIMITS, request(Profile(max_torque_nm=0.9), max_torque_nm=0.8))
    assert (gentle["torque_nm"].lo, gentle["torque_nm"].hi) == (-0.8, 0.8)


def test_a_refusal_in_words():
    row = replace(HARD_LIMITS["current_ma"], lo=2.0, reason="because")
    assert str(limits.check(row, 130.5)) == "current_ma 130.5 mA is outside 2 … 100 (hard limit, over by 30.5): because"
    assert str(limits.check(row, 0.5)) == "current_ma 0.5 mA is outside 2 … 100 (hard limit, under by 1.5): because"
    assert str(limits.check(row, math.nan)) == "current_ma nan mA is outside 2 … 100 (hard limit): because"
    assert str(limits.check(row, math.inf)) == "current_ma inf mA is outside 2 … 100 (hard limit): because"
    rest = replace(HARD_LIMITS["rest_between_tests_s"], reason="because")
    short = "rest_between_tests_s 0.25 s is not at least 1 (hard limit, under by 0.75): because"
    assert str(limits.check(rest, 0.25)) == short
    assert all("inf" not in str(limits.check(row, math.nan)) for row in HARD_LIMITS.values())


def test_a_stimulator_s_steps_round_toward_zero_and_what_is_too_short_is_no_pulse():
    coarse = limits.Steps(pulse_width_us=4.0, current_ma=2.0, shortest_us=20.0)
    assert [coarse.width_us(us) for us in (0.0, 19.9, 20.0, 23.9, 24.0)] == [0, 0, 20, 20, 24]
    assert [coarse.current(ma) for ma in (0.0, 1.9, 2.0, 3.9)] == [0.0, 0.0, 2.0, 2.0]
    assert limits.Steps() == limits.FINEST == limits.Steps(1.0, 0.5, 1.0)
    assert admit(Pulse(23.9, 3.9), HARD_LIMITS, coarse) == Admitted(20, 2.0)
    assert Admitted(300, 20.0).charge_uc == pytest.approx(6.0)
    assert Pulse(300.0, 20.0).charge_uc == pytest.approx(6.0)


def test_every_limit_has_its_reason_and_source():
    for name, row in HARD_LIMITS.items():
        assert row.name == name
        assert row.reason
        assert row.source
        assert row.lo < row.hi


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


BOUNDS = AdaptivePlan(max_duration_s=9.0, max_torque_time_nms=1e3)


def request(profile: Profile, **fields: Any) -> TestPlan:
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


def test_what_the_kind_of_a_test_narrows_is_one_row_with_its_owner():
    """The angle of profile and request, no pulse in a passive test, and the end of an adaptive one."""
    at = Profile(angle_range_rad=(0.5, 1.5))
    plain = limits.for_plan(HARD_LIMITS, request(Profile()))
    for profile, fields, name, owner, lo, hi in (
        (at, {}, "angle_rad", "participant's profile", 0.5, 1.5),
        (Profile(), {"angle": AnglePlan(range_rad=(0.6, 1.4))}, "angle_rad", "request", 0.6, 1.4),
        (at, {"angle": AnglePlan(range_rad=(0.6, 1.4))}, "angle_rad", "request", 0.6, 1.4),
        (Profile(), {"kind": PASSIVE}, "pulse_width_us", "passive test", plain["pulse_width_us"].lo, 0.0),
        (Profile(), {"adaptive": BOUNDS}, "duration_s", "request", plain["duration_s"].lo, 9.0),
    ):
        row = replace(plain[name], owner=owner, lo=lo, hi=hi)
        assert limits.for_plan(HARD_LIMITS, request(profile, **fields)) == {**plain, name: row}
    wide = AnglePlan(range_rad=(0.1, 2.0))
    assert limits.for_plan(HARD_LIMITS, request(at, angle=wide)) == limits.for_plan(HARD_LIMITS, request(at))


def test_what_is_refused_is_refused_at_its_place():
    row = HARD_LIMITS["current_ma"]
    limits.refuse(row, row.hi, "request")
    with pytest.raises(RefusedError) as refused:
        limits.refuse(row, row.hi + 1, "request")
    assert str(refused.value) == f"request: {limits.check(row, row.hi + 1)}"


def test_clients_are_told_the_bounds_of_this_rig():
    """Finite numbers or none, so that they pass through JSON; whose bound it is beside each."""
    table = limits.tightened(HARD_LIMITS, "current_ma", 60.0, "rig file")
    told = limits.bounds(table)
    assert set(told) == set(HARD_LIMITS)
    assert (told["current_ma"].hi, told["current_ma"].owner) == (60.0, "rig file")
    assert (told["pulse_width_us"].hi, told["pulse_width_us"].owner) == (500.0, "hard limit")
    assert told["width_rise_us"].lo is None and told["rest_between_tests_s"].hi is None
    assert (told["torque_nm"].lo, told["torque_nm"].unit) == (-60.0, "N·m")
    status = Status(state="ready", limits=told)
    assert Status.model_validate_json(status.model_dump_json()) == status

"""Plans and protocols: limits over the whole of a test, mistakes named."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from pydantic import ValidationError

from stimrig.rig import limits, plan, protocols
from stimrig.rig.control.rig import read_request
from stimrig.rig.errors import PlanError, RefusedError
from stimrig.rig.limits import HARD_LIMITS
from stimrig.rig.messages import Profile, RecruitmentTable, SegmentPlan, TestPlan


def built(segments: list[SegmentPlan] | None = None, rate_hz: float = 40.0, **profile: float) -> plan.PlannedTest:
    request = TestPlan(
        test_id="t", participant="P", profile=Profile(**profile), segments=segments, pulse_rate_hz=rate_hz
    )
    return plan.build(request, limits.for_profile(HARD_LIMITS, request.profile))


def widths(*values: float) -> list[SegmentPlan]:
    return [SegmentPlan(name="mine", sequence="widths", settings={"pulse_width_us": list(values)})]


def test_preview():
    test = built()
    short = plan.preview(
        built(widths(0.0, 50.0, 100.0)), RecruitmentTable(pulse_width_us=[0, 50, 100], torque_nm=[0, 1, 9])
    )
    assert (short.charge_uc, short.torque_time_nms) == pytest.approx((3.0, 10 / 40))
    shown = plan.preview(test, RecruitmentTable(pulse_width_us=[0, 300], torque_nm=[0, 6]))
    assert shown.duration_s == pytest.approx(38.7)
    assert shown.charge_uc == test.charge_uc == pytest.approx(test.pulse_width_us.sum() * 0.02)
    assert shown.torque_time_nms == pytest.approx(np.sum(test.pulse_width_us) * 0.02 / 40)
    assert plan.preview(test).torque_time_nms is None
    assert shown.segments[1] == {"name": "prbs", "start_s": 2.0, "end_s": pytest.approx(8.3)}
    with pytest.raises(PlanError, match="recruitment"):
        plan.preview(test, RecruitmentTable(pulse_width_us=[0, 0], torque_nm=[0, 6]))


@pytest.mark.parametrize(
    ("segments", "rate_hz", "profile", "words"),
    [
        (widths(100, 301), 40.0, {}, "mine, pulse 2: pulse_width_us 301"),
        (widths(100, math.nan), 40.0, {}, "widths"),
        (widths(-5), 40.0, {}, "mine, pulse 1"),
        (None, 61.0, {}, "pulse_rate_hz 61"),
        (None, math.nan, {}, "pulse_rate_hz nan"),
        (None, 40.0, {"current_ma": 120.0, "max_pulse_width_us": 400.0}, "current_ma 120"),
        (None, 40.0, {"current_ma": 100.0, "max_pulse_width_us": 450.0}, "charge_per_phase_uc 40.05"),
        (widths(*[390.0] * 60), 50.0, {"current_ma": 100.0, "max_pulse_width_us": 390.0}, "charge_per_second_uc"),
        (widths(*[1.0] * 13_000), 40.0, {}, "duration_s 325"),
        (widths(*[300.0] * 11_000), 40.0, {}, "charge_per_test_uc"),
    ],
)
def test_limits_hold_over_the_whole_test(
    segments: list[SegmentPlan] | None, rate_hz: float, profile: dict[str, float], words: str
):
    with pytest.raises((RefusedError, PlanError), match=words):
        built(segments, rate_hz, **profile)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"pulse_width_us": [50.0, 100.0, 0.0, 50.0]}, None),
        (
            {"pulse_width_us": [50.0, 100.5]},
            "mine, pulse 2: width_rise_us 50.5 µs/pulse is not at most 50 .* over by 0.5",
        ),
        ({"pulse_width_us": [60.0]}, "mine, pulse 1: width_rise_us 60"),
        ({"pulse_width_us": [60.0, 0.0, 300.0], "jumps": True}, None),
    ],
)
def test_a_width_rises_slowly_where_the_sequence_does_not_jump_by_design(
    settings: dict[str, object], words: str | None
):
    segments = [SegmentPlan(name="mine", sequence="widths", settings=settings)]
    if words is None:
        assert built(segments).pulse_width_us.max() > 0
        return
    with pytest.raises(RefusedError, match=words):
        built(segments)


def test_a_steep_ramp_is_refused_and_a_rise_counts_from_the_segment_before():
    steep = SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 0.1, "down_s": 1.0})
    with pytest.raises(RefusedError, match="ramp, pulse 1: width_rise_us 75"):
        built([steep])
    step = SegmentPlan(name="hold", sequence="steps", settings={"on_s": 0.5, "off_s": 0.0, "repeats": 1})
    assert built([step, *widths(310.0)], max_pulse_width_us=310.0).duration_s > 0.5


def test_the_requests_own_maximum_scales_the_sequences():
    plan_of = TestPlan(test_id="t", participant="P", profile=Profile(), max_pulse_width_us=120.0)
    assert plan.build(plan_of, limits.for_plan(HARD_LIMITS, plan_of)).pulse_width_us.max() == 120.0


LONG = {
    "four of steps": (
        [("steps", {"on_s": 120.0, "off_s": 120.0, "repeats": 1000})] * 4,
        "segment 1: duration_s 240000",
    ),
    "prbs": ([("prbs", {"chips": 100_000, "clock_pulses": 200})], "segment 1: duration_s 500000"),
    "staircase": ([("staircase", {"levels": 100, "hold_s": 60.0})], "segment 1: duration_s 12000"),
    "many rests": ([("rest", {"duration_s": 100.0})] * 4, "segment 4: duration_s 400"),
    "many segments": ([("rest", {"duration_s": 0.1})] * 201, "201 segments, at most 200"),
    "a long list": ([("widths", {"pulse_width_us": [0.0] * 18_001})], "at most 18000"),
    "holds without end": ([("multilevel", {"max_hold_s": 1e300})], "max_hold_s"),
}


@pytest.mark.parametrize("name", LONG)
def test_what_is_too_long_is_refused_before_it_is_built(name: str, monkeypatch: pytest.MonkeyPatch):
    asked, words = LONG[name]
    segments = [SegmentPlan(name="x", sequence=sequence, settings=settings) for sequence, settings in asked]
    monkeypatch.setattr(plan.sequences, "build", lambda *_: pytest.fail("it was built"))
    with pytest.raises((RefusedError, PlanError), match=words):
        built(segments)


NONE = {
    "rest": {"duration_s": 0.001},
    "steps": {"on_s": 0.001, "off_s": 0.0},
    "staircase": {"hold_s": 0.001},
    "multilevel": {"duration_s": 0.001},
    "ramp": {"up_s": 0.001, "down_s": 0.001},
}


@pytest.mark.parametrize("sequence", NONE)
def test_a_segment_without_a_pulse_is_a_mistake_in_the_plan(sequence: str):
    short = SegmentPlan(name="x", sequence=sequence, settings=NONE[sequence])
    paper = plan.library().default
    for segments in ([short], [*paper, short], [short, *paper]):
        with pytest.raises(PlanError, match=r"segment \d \(x\): too short for one pulse at 40 pulses/s"):
            built(segments)


def test_mistakes_name_the_segment():
    with pytest.raises(PlanError, match="segments is empty"):
        built([])
    with pytest.raises(PlanError, match=r"segment 1 \(x\): sequence 'nope' is unknown"):
        built([SegmentPlan(name="x", sequence="nope")])


def built_of(protocol: str, **more: float) -> plan.PlannedTest:
    profile = Profile(**{"max_pulse_width_us": 300.0, **more})
    request = TestPlan(test_id="t", participant="P", profile=profile, protocol=protocol)
    return plan.build(request, limits.for_plan(limits.HARD_LIMITS, request))


@pytest.mark.parametrize("protocol", protocols.LIBRARY)
@pytest.mark.parametrize("comfort_us", [1.0, 77.3, 280.0, 500.0])
def test_every_protocol_fits_every_comfort_maximum(protocol: str, comfort_us: float):
    test = built_of(protocol, max_pulse_width_us=comfort_us)
    assert test.pulse_width_us.max() == comfort_us
    names = {segment.name for segment in test.segments}
    assert {"ramp", "validate"} <= names and names & {"prbs", "levels"}
    for segment in test.segments:
        assert segment.name != "rest" or not test.pulse_width_us[segment.start : segment.end].any()
    held_out = next(segment for segment in test.segments if segment.name == "validate")
    assert test.pulse_width_us[held_out.start : held_out.end].max() > 0.7 * comfort_us
    assert np.all(test.pulse_width_us[-40:] == 0)


def test_what_is_told_is_what_is_played():
    told = plan.library()
    durations_s = {one.id: round(one.duration_s, 6) for one in told.protocols}
    assert durations_s == {"paper": 38.7, "short": 26.2, "levels": 38.7, "mixed": 38.7}
    for one in told.protocols:
        test = built_of(one.id)
        assert test.duration_s == pytest.approx(one.duration_s)
        assert [segment.name for segment in test.segments] == one.segments
    assert [segment.name for segment in told.default] == told.protocols[0].segments
    assert told.protocols[0].segments == ["rest", "prbs", "levels", "rest", "ramp", "rest", "validate", "rest"]
    assert built().plan.protocol == protocols.DEFAULT == told.protocols[0].id


def test_the_two_prbs_of_the_short_test_have_two_mean_levels():
    test = built_of("short", max_pulse_width_us=250.0)
    low, high = (test.pulse_width_us[s.start : s.end] for s in test.segments if s.name == "prbs")
    assert (low.max(), high.max()) == (187.0, 250.0)
    assert 1.2 < high.mean() / low.mean() < 1.5


@pytest.mark.parametrize("protocol", ["levels", "mixed"])
def test_levels_are_random_a_quarter_without_pulses_and_of_no_higher_dose(protocol: str):
    test = built_of(protocol)
    levels_us = next(test.pulse_width_us[s.start : s.end] for s in test.segments if s.name == "levels")
    assert levels_us[levels_us > 0].min() >= 36 and levels_us.max() > 280
    assert np.mean(levels_us == 0) == pytest.approx(0.25, abs=0.02)
    held = np.diff(np.flatnonzero(np.diff(levels_us)))
    assert held.min() >= 3 and np.median(held) < 12 and np.unique(levels_us).size > 15
    assert test.charge_uc < built_of("paper").charge_uc


def test_an_unknown_protocol_is_refused_with_those_there_are():
    for protocol in ("", "../paper"):
        with pytest.raises(PlanError, match="is unknown; use one of mixed, paper, short, levels"):
            built_of(protocol)


@pytest.mark.parametrize("wrong", [True, "20"])
def test_truth_and_text_are_no_numbers(wrong: object):
    for asked in (
        {"kind": "start", "plan": {"test_id": "t", "participant": "P", "profile": {"current_ma": wrong}}},
        {"kind": "calibrate-start", "calibration_id": "c", "participant": "P", "by": "t", "current_ma": wrong},
    ):
        with pytest.raises(ValidationError, match="current_ma"):
            read_request(json.dumps(asked).encode())

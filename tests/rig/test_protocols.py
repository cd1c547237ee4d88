"""The library of protocols: each is a test that any participant's limits admit, and what it says of itself holds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stimrig.rig import limits, plan, protocols
from stimrig.rig.errors import PlanError, RefusedError
from stimrig.rig.messages import Profile, TestPlan


def built(protocol: str, **more: float) -> plan.PlannedTest:
    profile = Profile(**{"max_pulse_width_us": 300.0, **more})
    request = TestPlan(test_id="t", participant="P", profile=profile, protocol=protocol)
    return plan.build(request, limits.for_plan(limits.HARD_LIMITS, request))


@pytest.mark.parametrize("protocol", protocols.LIBRARY)
@pytest.mark.parametrize("comfort_us", [1.0, 77.3, 280.0, 500.0])
def test_every_protocol_fits_every_comfort_maximum(protocol: str, comfort_us: float):
    test = built(protocol, max_pulse_width_us=comfort_us)
    assert test.pulse_width_us.max() == comfort_us
    assert {"prbs", "ramp", "validate"} <= {segment.name for segment in test.segments}
    for segment in test.segments:
        assert segment.name != "rest" or not test.pulse_width_us[segment.start : segment.end].any()
    held_out = next(segment for segment in test.segments if segment.name == "validate")
    assert test.pulse_width_us[held_out.start : held_out.end].max() > 0.7 * comfort_us
    assert np.all(test.pulse_width_us[-40:] == 0)


@pytest.mark.parametrize(("protocol", "duration_s"), [("paper", 38.7), ("short", 26.2)])
def test_what_is_told_is_what_is_played(protocol: str, duration_s: float):
    told = {one.id: one for one in plan.library().protocols}[protocol]
    test = built(protocol)
    assert test.duration_s == pytest.approx(told.duration_s) == pytest.approx(duration_s)
    assert [segment.name for segment in test.segments] == told.segments
    assert told.description.endswith(".")


def test_the_default_is_the_papers_and_is_told_first():
    told = plan.library()
    assert told.protocols[0].id == protocols.DEFAULT == "paper"
    assert [segment.name for segment in told.default] == told.protocols[0].segments
    assert told.protocols[0].segments == ["rest", "prbs", "rest", "ramp", "rest", "validate", "rest"]
    assert np.array_equal(
        built("paper").pulse_width_us, built(TestPlan.model_fields["protocol"].default).pulse_width_us
    )


def test_the_two_prbs_of_the_short_test_have_two_mean_levels():
    test = built("short", max_pulse_width_us=250.0)
    low, high = (test.pulse_width_us[s.start : s.end] for s in test.segments if s.name == "prbs")
    assert (low.max(), high.max()) == (187.0, 250.0)
    assert 1.2 < high.mean() / low.mean() < 1.5


@pytest.mark.parametrize("protocol", ["", "Paper", "../paper", "__init__", "short\0", "papershort"])
def test_an_unknown_protocol_is_refused_with_those_there_are(protocol: str):
    with pytest.raises(PlanError, match="is unknown; use one of paper, short"):
        built(protocol)


@pytest.mark.parametrize("comfort_us", [math.nan, math.inf, -math.inf, -1.0])
def test_a_comfort_maximum_that_is_none_is_refused(comfort_us: float):
    with pytest.raises((RefusedError, PlanError)):
        built("short", max_pulse_width_us=comfort_us)

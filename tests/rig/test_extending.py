"""Extensions at the rig itself: who may extend which test, when, and what its profile and its rests say."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.rig.clock import utc_text
from stimrig.rig.control.calibration import end_of_day_s
from stimrig.rig.control.replies import previewed
from stimrig.rig.errors import BusyError, PlanError, RefusedError, TooLateError
from stimrig.rig.messages import AdaptivePlan, Extended, LiveEvent, Profile, SegmentPlan, TestPlan
from stimrig.rig.requests import EnoughRequest, ExtendRequest, PreviewRequest  # fmt: skip
from tests.rig.fakes import hold, rest
from tests.rig.live import LiveRig

KEY = "0123456789abcdef"
Make = Callable[..., LiveRig]


def plan(live: LiveRig, test_id: str = "one", max_duration_s: float = 60.0, **fields: Any) -> TestPlan:
    bounds = AdaptivePlan(max_duration_s=max_duration_s, max_torque_time_nms=1e4)
    return live.plan(test_id, adaptive=bounds, **fields)


def added(on_s: float = 0.5) -> list[SegmentPlan]:
    return [hold("added", on_s, off_s=0.1)]


def request(after: int = 20, test_id: str = "one", key: str = KEY) -> ExtendRequest:
    return ExtendRequest(test_id=test_id, key=key, after=after, segments=added())


def extend(live: LiveRig, *which: Any, **key: str) -> Extended:
    return live.ask(live.rig.player.extend(request(*which, **key)))


def test_from_start_to_sealed_file_with_one_that_extends_and_says_enough(make: Make):
    live = make()
    for short in ("", "15 characters!!"):
        with pytest.raises(PlanError, match="at least 16 characters"):
            live.start(plan(live), short)
    live.start(plan(live, hold_s=20.0), KEY)
    with pytest.raises(BusyError):
        live.start(plan(live, "two"), KEY[::-1])  # its key opens nothing
    for wrong in ("", KEY[::-1], KEY[:-1], KEY + "0", "0123456789abcdeF", "\ud800" * 16):
        with pytest.raises(PlanError, match="not the key"):
            extend(live, 20, key=wrong)
    for ask in (
        lambda: extend(live, 20, "two"),
        lambda: live.ask(live.rig.player.enough(EnoughRequest(test_id="two"))),
    ):
        with pytest.raises(TooLateError, match="test 'two' is not running"):
            ask()
    first = extend(live, 20)
    assert (first.laid, first.boundary_s, first.ended_by) == (44, 1.1, "")
    assert first.duration_left_s == pytest.approx(60 - 1.1)
    live.wait("running")
    live.wait_pulses(5)
    assert extend(live, 44).laid == 68
    event = live.event(samples=True)
    assert event is not None and event.samples is not None and event.pulse_time_s
    assert (event.laid, event.boundary_s, event.duration_s) == (68, 1.7, 60.0)
    assert [(s.name, s.by) for s in event.laid_segments] == [("rest", "plan"), *[("added", "extension")] * 2]
    assert len(event.samples.torque_nm) == len(event.samples.counter) == len(event.samples.host_time_s) > 0
    assert np.all(np.diff(event.samples.counter) == 1)
    told = event.outcomes
    assert told is not None and told.index == list(range(len(told.index))) and len(told.index) > 20
    assert (told.pulse_width_us, told.status) == (event.pulse_width_us, [1] * 20 + [0] * (len(told.index) - 20))
    assert all(a < b for a, b in zip(told.written_time_s, told.acknowledged_time_s, strict=True) if a and b)
    assert LiveEvent.model_validate(json.loads(event.model_dump_json())) == event, "read as it was sent"
    live.machine.wait(0.1)
    plain = live.event()
    assert plain is not None
    assert (plain.outcomes, plain.samples) == (None, None), "only who chooses pieces needs them"
    assert live.rig.status().duration_s == 60.0
    ending = live.ask(live.rig.player.enough(EnoughRequest(test_id="one", by="nurse")))
    assert (ending.ended_by, ending.boundary_s) == ("enough", pytest.approx(2.0, abs=0.7))
    live.wait("ready")
    finished = live.finished
    assert (finished.outcome, finished.summary["ended_by"]) == ("completed", "enough")
    assert finished.summary["torque_time_nms"] > 0.1
    with h5py.File(str(finished.recording_path)) as file:
        assert set(file["segments/name"].asstr()[:]) == {"rest", "added"}
        assert KEY not in str(dict(file.attrs))


def test_neither_before_nor_after_a_test_nor_when_it_is_stopped(make: Make):
    live = make()

    def refused(words: str) -> None:
        for ask in (lambda: extend(live, 20), lambda: live.ask(live.rig.player.enough(EnoughRequest(test_id="one")))):
            with pytest.raises(TooLateError, match=words):
                ask()

    refused("not running")
    live.start(plan(live, hold_s=20.0), KEY)
    live.wait("running")
    live.wait_pulses(5)
    assert live.stop("that hurts").confirmed
    refused("is being ended|not running")
    live.wait("latched")
    refused("not running")
    count = len(live.stimulator.sent)
    live.rearm()
    refused("not running")
    live.machine.wait(0.4)
    assert len(live.stimulator.sent) == count


def test_a_fixed_test_and_a_calibration_are_not_extended(make: Make):
    live = make()
    live.start(live.plan("one", hold_s=20.0), KEY)
    for ask in (lambda: extend(live, 840), lambda: live.ask(live.rig.player.enough(EnoughRequest(test_id="one")))):
        with pytest.raises(PlanError, match="fixed plan"):
            ask()


def test_the_rest_between_tests_is_counted_to_the_first_pulse_that_may_come(make: Make):
    """The fixed plan would not stimulate for a minute, an extension might after half a second."""
    live = make()
    live.play("before", hold_s=0.5)
    rested = Profile(rest_between_tests_s=30.0)
    quiet = [rest(0.5), rest(60.0)]
    assert live.start(live.plan("fixed", profile=rested, segments=[*quiet, *added()])).state == "arming"
    live.stop("that was only to show it")
    live.wait("latched")
    live.rearm()
    with pytest.raises(RefusedError, match=r"rest_between_tests_s .*wait 2\d"):
        live.start(plan(live, profile=rested, segments=[*quiet, *added()], max_duration_s=90.0), KEY)


def test_the_day_must_last_as_long_as_the_bound(make: Make):
    live = make()
    midnight_s = end_of_day_s(live.clock.unix_s())
    live.clock.set_unix_ahead(midnight_s - 10.0 - live.clock.unix_s())
    day = Profile(
        sensory_pulse_width_us=20.0, motor_pulse_width_us=60.0,
        set_at_utc=utc_text(midnight_s - 3600), expires_at_utc=utc_text(midnight_s),
    )  # fmt: skip
    late = plan(live, profile=day, max_duration_s=60.0)
    with pytest.raises(RefusedError, match="before the end of this test of 15 s"):
        live.start(late, KEY)
    with pytest.raises(RefusedError, match="before the end of this test of 15 s"):
        previewed(PreviewRequest(plan=late), live.rig.table, midnight_s - 10.0, live.clock.speed)
    assert live.start(plan(live, profile=day, max_duration_s=30.0), KEY).state == "arming"


def test_until_a_tests_clock_runs_nothing_is_told_of_it(make: Make):
    """Its samples have no time on it yet, and the gate still holds what became of the last test's pulses."""
    live = make()
    live.play("before", hold_s=0.5)
    live.start(live.plan("one", hold_s=2.0))
    told = []
    while not told or told[-1].test_id is None:
        live.machine.wait(0.002)
        told += [event for event in [live.event(samples=True)] if event is not None]
        assert live.clock.now_s() < 1e5
    assert {event.test_id for event in told[:-1]} <= {None}
    assert all(event.outcomes is None or event.outcomes.index == [] for event in told[:-1])
    live.wait_pulses(20)
    live.machine.wait(0.3)
    rest = live.event(samples=True)
    outcomes = [event.outcomes for event in (told[-1], rest) if event is not None and event.outcomes is not None]
    index = [number for one in outcomes for number in one.index]
    assert index == list(range(len(index))) and len(index) >= 20, "each of its own pulses, once"

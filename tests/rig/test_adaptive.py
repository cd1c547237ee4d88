"""A test that is extended while it plays: what plays, what comes too late, and how it ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stimrig.rig import plan
from stimrig.rig.errors import BusyError, RigError, TooLateError
from stimrig.rig.messages import AHEAD, SegmentPlan
from tests.rig.adaptive import FIXED, RATE_HZ, adaptive, extend, hold, refusals, rest, widths_sent
from tests.rig.fakes import VirtualRig, slow_work


def test_if_nobody_extends_it_the_fixed_plan_plays_and_a_second_without_pulses(tmp_path: Path):
    rig = adaptive(tmp_path)
    result = rig.execute()
    assert (result.outcome, result.summary["ended_by"]) == ("completed", "plan")
    assert result.summary["duration_s"] == pytest.approx(3.475)
    (tmp_path / "fixed").mkdir()
    same = VirtualRig(tmp_path / "fixed", FIXED)
    assert same.execute().summary["ended_by"] == "plan"
    assert widths_sent(rig) == widths_sent(same)
    recording = rig.recording()
    assert recording.names == ["rest", "first", "ramp", "rest"]
    assert recording.columns["segments/start_s"].tolist() == [0.0, 0.5, 1.5, 2.5]
    planned_us = recording.columns["pulses/pulse_width_us"]
    assert np.array_equal(planned_us[: len(same.test.pulse_width_us)], same.test.pulse_width_us)
    assert np.flatnonzero(planned_us)[-1] == len(planned_us) - 1 - RATE_HZ
    assert (recording.attributes["adaptive"], recording.attributes["ended_by"]) == (1, "plan")
    assert same.recording().attributes["adaptive"] == 0


def test_what_is_added_plays_at_its_boundary_and_the_fixed_plan_goes_on_after_it(tmp_path: Path):
    rig = adaptive(tmp_path)
    added = [hold("first", max_pulse_width_us=100.0), SegmentPlan(name="validate", sequence="multilevel",
             settings={"duration_s": 1.0, "seed": 3})]  # fmt: skip
    rig.at(0.2, lambda: extend(rig, 20, added))
    result = rig.execute()
    recording = rig.recording()
    assert recording.names == ["rest", "first", "validate", "first", "ramp", "rest"], "a name may come again"
    assert recording.columns["segments/start_s"].tolist() == [0.0, 0.5, 1.5, 2.5, 3.5, 4.5]
    sent_us = recording.columns["pulses/sent_pulse_width_us"]
    assert np.all(sent_us[20:60] == 100) and np.all(sent_us[100:140] == 300)
    assert result.summary["duration_s"] == pytest.approx(len(sent_us) / RATE_HZ)
    times = np.array([time_s for time_s, _ in rig.stimulator.sent])
    assert np.allclose((times - times[0]) * RATE_HZ, np.round((times - times[0]) * RATE_HZ))
    assert '"by": "extension"' in recording.attributes["laid"] and '"seed": 3' in recording.attributes["laid"]


def test_an_answer_to_an_old_boundary_is_refused_and_so_is_the_same_one_twice(tmp_path: Path):
    rig = adaptive(tmp_path)
    found: list[RigError] = []
    rig.at(0.2, lambda: extend(rig, 20, [hold("once")]))
    rig.at(0.21, lambda: found.extend(refusals(lambda: extend(rig, 20, [hold("again")]))))
    rig.at(2.0, lambda: found.extend(refusals(lambda: extend(rig, 60, [hold("late")]))))
    rig.execute()
    assert all(isinstance(error, TooLateError) for error in found) and len(found) == 2
    assert "60 pulses are laid" in str(found[0]) and "100 pulses are laid" in str(found[1])
    assert rig.recording().names == ["rest", "once", "first", "ramp", "rest"]


@pytest.mark.parametrize("early", [True, False])
def test_the_boundary_is_decided_two_periods_before_it(tmp_path: Path, early: bool):
    rig = adaptive(tmp_path)
    at_s = 0.5 - AHEAD / RATE_HZ + (-0.001 if early else 0.001)
    ask = lambda: extend(rig, 20, [hold("added")])  # noqa: E731
    rig.at(at_s, ask if early else lambda: found.extend(refusals(ask)))
    found: list[RigError] = []
    rig.execute()
    assert (rig.recording().names[1], len(found)) == (("added", 0) if early else ("first", 1))


@pytest.mark.parametrize("takes_s", [0.05, 0.4])
def test_while_an_extension_is_checked_the_test_goes_on(tmp_path: Path, takes_s: float):
    """If the boundary passes meanwhile, nothing is laid; a second one is refused until the first is judged."""
    rig, found = adaptive(tmp_path), []

    def ask() -> None:
        slow_work(rig.machine, takes_s)
        found.extend(rig.machine.tasks.begin(rig.run.score.extend(20, [hold(name)]), name) for name in ("a", "b"))
        slow_work(rig.machine)

    rig.at(0.2, ask)
    result = rig.execute()
    late = takes_s > 0.3
    assert result.outcome == "completed" and max(rig.gate.lateness_s) < 1e-9
    assert [type(one.error) for one in found] == [TooLateError if late else type(None), BusyError]
    assert rig.recording().names == ["rest", *([] if late else ["a"]), "first", "ramp", "rest"]


@pytest.mark.parametrize(("at_once", "pulses"), [(True, 30), (False, 40)])
def test_enough_ends_it_well(tmp_path: Path, at_once: bool, pulses: int):
    rig = adaptive(tmp_path)
    rig.at(0.6, lambda: extend(rig, 60, [hold("never played")]))
    rig.at(1.21, lambda: rig.run.score.enough("P1's nurse", at_once))
    result = rig.execute()
    assert (result.outcome, result.summary["ended_by"], result.evidence.confirmed) == ("completed", "enough", True)
    assert len(rig.stimulator.sent) == pulses
    recording = rig.recording()
    assert recording.names == ["rest", "first", "rest"]
    assert result.summary["duration_s"] == pytest.approx(0.5 + pulses / RATE_HZ + 1.0)
    assert len(recording.columns["pulses/status"]) == 20 + pulses + 40
    told = next(event for event in recording.events if event["event"] == "ended")
    assert (told["by"], told["reason"], told["index"]) == ("enough", "P1's nurse", 20 + pulses)


def test_enough_twice_may_only_end_it_sooner(tmp_path: Path):
    rig = adaptive(tmp_path)
    score = rig.run.score
    for at_s, at_once in ((0.7, False), (0.8, False), (1.0, True), (1.1, True), (1.2, False)):
        rig.at(at_s, lambda at_once=at_once: score.enough("me", at_once))
    found: list[RigError] = []
    rig.at(1.3, lambda: found.extend(refusals(lambda: extend(rig, len(score.laid), [hold()]))))
    result = rig.execute()
    assert result.summary["duration_s"] == pytest.approx(0.5 + len(rig.stimulator.sent) / RATE_HZ + 1.0)
    assert 19 <= len(rig.stimulator.sent) <= 21
    assert "is ending (enough)" in str(found[0])
    assert [event["event"] for event in rig.recording().events].count("ended") == 2


@pytest.mark.parametrize(("before_s", "pulses"), [(0.06, 40), (0.035, 40), (0.01, 41), (-0.01, 80)])
def test_enough_right_before_a_boundary_begins_no_further_segment(tmp_path: Path, before_s: float, pulses: int):
    """Once the next segment's first pulse waits to be sent, it alone is sent: at most one more pulse."""
    rig = adaptive(tmp_path, fixed=[rest(0.5), hold("plays"), hold("next"), hold("after", on_s=3.0)])
    rig.at(1.5 - before_s, lambda: rig.run.score.enough("me", at_once=False))
    result = rig.execute()
    assert (result.summary["ended_by"], len(rig.stimulator.sent)) == ("enough", pulses)
    assert result.summary["duration_s"] == pytest.approx(0.5 + pulses / RATE_HZ + 1.0)


def test_enough_before_the_first_pulse_sends_none(tmp_path: Path):
    rig = adaptive(tmp_path)
    rig.run.score.enough("me", at_once=True)
    result = rig.execute()
    assert (result.outcome, rig.stimulator.sent, result.summary["duration_s"]) == ("completed", [], pytest.approx(1.0))
    assert rig.recording().names == ["rest"]


@pytest.mark.parametrize("cause", ["stopped", "fault"])
def test_a_stop_is_a_stop(tmp_path: Path, cause: Any):
    """During the fall of the torque and after it nothing is laid, and no pulse follows."""
    rig = adaptive(tmp_path)
    score, found = rig.run.score, []
    rig.at(0.3, lambda: extend(rig, 20, [hold("added", on_s=3.0)]))
    rig.at(1.0, lambda: rig.halt.set(cause, "that hurts"))
    for at_s in (1.001, 1.01, 1.05):
        rig.at(at_s, lambda: found.extend(refusals(
            lambda: extend(rig, len(score.laid), [hold()]), lambda: score.enough("me", True)
        )))  # fmt: skip
    result = rig.execute()
    size = rig.path.stat().st_size
    found += refusals(lambda: extend(rig, len(score.laid), [hold()]), lambda: score.enough("me", False))
    assert (result.outcome, result.summary["ended_by"], len(found)) == (cause, cause, 8)
    assert all(isinstance(error, TooLateError) for error in found)
    assert rig.stimulator.sent[-1][0] <= rig.halt.time_s
    recording = rig.recording()
    assert (recording.names, recording.attributes["ended_by"]) == (["rest", "added"], cause)
    assert rig.path.stat().st_size == size


def test_the_earliest_pulse_is_that_of_an_extension(tmp_path: Path):
    """The rest between two tests is judged by it, although the fixed plan would begin later."""
    rig = adaptive(tmp_path, fixed=[rest(0.5), rest(2.0), hold("first")])
    assert rig.test.first_pulse == 20
    assert plan.build(rig.plan.model_copy(update={"adaptive": None}), rig.table).first_pulse == 100

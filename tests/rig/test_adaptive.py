"""A test that is extended while it plays: what plays, what is written, and that no limit of the whole is broken."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.rig import archive, assembly, journal, limits
from stimrig.rig.clock import utc_text
from stimrig.rig.control.calibration import end_of_day_s
from stimrig.rig.errors import BusyError, JournalError, PlanError, RecordingError, RefusedError, RigError, TooLateError
from stimrig.rig.journal import Kind, LaidBlock
from stimrig.rig.messages import AHEAD, AdaptivePlan, Extended, LiveEvent, Profile, SegmentPlan, TestPlan
from stimrig.rig.requests import EnoughRequest, ExtendRequest
from stimrig.rig.score import MAX_CHECKED, MAX_EXTENSION_S, MAX_EXTENSION_SEGMENTS
from stimrig.rig.signals import PulseStatus
from tests.rig.fakes import FIXED, PULSES_HZ, VirtualRig, adaptive, extend, hold, refusals, rest, slow_work, widths_sent
from tests.rig.live import LiveRig
from tests.rig.test_damaged import blocks_of

pytestmark = pytest.mark.slow


@pytest.fixture
def rig(tmp_path: Path) -> VirtualRig:
    return adaptive(tmp_path)


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
    assert np.flatnonzero(planned_us)[-1] == len(planned_us) - 1 - PULSES_HZ
    assert (recording.attributes["adaptive"], recording.attributes["ended_by"]) == (1, "plan")
    assert same.recording().attributes["adaptive"] == 0


def test_an_answer_to_an_old_boundary_is_refused_and_so_is_the_same_one_twice(rig: VirtualRig):
    found: list[RigError] = []
    rig.at(0.2, lambda: extend(rig, 20, [hold("once")]))
    rig.at(0.21, lambda: found.extend(refusals(lambda: extend(rig, 20, [hold("again")]))))
    rig.at(2.0, lambda: found.extend(refusals(lambda: extend(rig, 60, [hold("late")]))))
    rig.execute()
    assert all(isinstance(error, TooLateError) for error in found) and len(found) == 2
    assert "60 pulses are laid" in str(found[0]) and "100 pulses are laid" in str(found[1])
    assert rig.recording().names == ["rest", "once", "first", "ramp", "rest"]


@pytest.mark.parametrize("early", [True, False])
def test_the_boundary_is_decided_two_periods_before_it(rig: VirtualRig, early: bool):
    at_s = 0.5 - AHEAD / PULSES_HZ + (-0.001 if early else 0.001)
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


def test_enough_twice_may_only_end_it_sooner(rig: VirtualRig):
    score = rig.run.score
    for at_s, at_once in ((0.7, False), (0.8, False), (1.0, True), (1.1, True), (1.2, False)):
        rig.at(at_s, lambda at_once=at_once: score.enough("me", at_once))
    found: list[RigError] = []
    rig.at(1.3, lambda: found.extend(refusals(lambda: extend(rig, len(score.queue), [hold()]))))
    result = rig.execute()
    assert result.summary["duration_s"] == pytest.approx(0.5 + len(rig.stimulator.sent) / PULSES_HZ + 1.0)
    assert 19 <= len(rig.stimulator.sent) <= 21
    assert "is ending (enough)" in str(found[0])
    told = [event for event in rig.recording().events if event["event"] == "ended"]
    assert [(event["by"], event["reason"]) for event in told] == [("enough", "me")] * 2


@pytest.mark.parametrize(("before_s", "pulses"), [(0.06, 40), (0.035, 40), (0.01, 41), (-0.01, 80)])
def test_enough_right_before_a_boundary_begins_no_further_segment(tmp_path: Path, before_s: float, pulses: int):
    """Once the next segment's first pulse waits to be sent, it alone is sent: at most one more pulse."""
    rig = adaptive(tmp_path, fixed=[rest(0.5), hold("plays"), hold("next"), hold("after", on_s=3.0)])
    rig.at(1.5 - before_s, lambda: rig.run.score.enough("me", at_once=False))
    result = rig.execute()
    assert (result.summary["ended_by"], len(rig.stimulator.sent)) == ("enough", pulses)
    assert result.summary["duration_s"] == pytest.approx(0.5 + pulses / PULSES_HZ + 1.0)


def test_enough_before_the_first_pulse_sends_none(rig: VirtualRig):
    rig.run.score.enough("me", at_once=True)
    result = rig.execute()
    assert (result.outcome, rig.stimulator.sent, result.summary["duration_s"]) == ("completed", [], pytest.approx(1.0))
    assert rig.recording().names == ["rest"]


@pytest.mark.parametrize("cause", ["stopped", "fault"])
def test_a_stop_is_a_stop(rig: VirtualRig, cause: Any):
    """During the fall of the torque and after it nothing is laid, and no pulse follows."""
    score, found = rig.run.score, []
    rig.at(0.3, lambda: extend(rig, 20, [hold("added", on_s=3.0)]))
    rig.at(1.0, lambda: rig.halt.set(cause, "that hurts"))
    for at_s in (1.001, 1.01, 1.05):
        rig.at(at_s, lambda: found.extend(refusals(
            lambda: extend(rig, len(score.queue), [hold()]), lambda: score.enough("me", True)
        )))  # fmt: skip
    result = rig.execute()
    size = rig.path.stat().st_size
    found += refusals(lambda: extend(rig, len(score.queue), [hold()]), lambda: score.enough("me", False))
    assert (result.outcome, result.summary["ended_by"], len(found)) == (cause, cause, 8)
    assert all(isinstance(error, TooLateError) for error in found)
    assert rig.stimulator.sent[-1][0] <= rig.halt.time_s
    recording = rig.recording()
    assert (recording.names, recording.attributes["ended_by"]) == (["rest", "added"], cause)
    assert rig.path.stat().st_size == size


def test_each_segment_is_in_the_journal_before_its_first_pulse(rig: VirtualRig):
    rig.at(0.2, lambda: extend(rig, 20, [hold("added")]))
    rig.at(1.7, lambda: rig.run.score.enough("me", at_once=True))
    rig.execute()
    laid_to, seen = 20, []
    for kind, payload in journal.read(rig.path).blocks:
        if kind == Kind.EXTENSION:
            block = LaidBlock.from_bytes(payload)
            assert len(block.pulse_width_us) == block.segment.end - block.segment.start
            laid_to = block.segment.end
            seen.append(block.segment.by)
        elif kind == Kind.INTENT:
            assert journal.INTENT.unpack(payload)[0] < laid_to
    assert seen == ["extension", "plan", "end"]


def test_a_disk_that_takes_no_segment_ends_it_as_a_fault(tmp_path: Path):
    rig = adaptive(tmp_path)
    rig.at(0.2, lambda: setattr(rig.journal, "_failure", "disk full"))
    rig.at(0.3, lambda: refusals(lambda: extend(rig, 20, [hold()])))
    result = rig.execute()
    assert (result.outcome, result.reason, rig.stimulator.sent) == ("fault", "disk full", [])
    (tmp_path / "2").mkdir()
    rig = adaptive(tmp_path / "2")
    rig.journal._failure = "disk full"
    with pytest.raises(JournalError):
        extend(rig, 20, [hold()])
    assert len(rig.run.score.queue) == 20


def test_a_journal_cut_anywhere_or_without_a_laid_block_loses_no_pulse(tmp_path: Path):
    rig = adaptive(tmp_path)
    rig.at(0.2, lambda: extend(rig, 20, [hold("added", max_pulse_width_us=150.0)]))
    rig.at(1.8, lambda: rig.run.score.enough("me", at_once=True))
    rig.execute()
    whole = rig.path.read_bytes()
    copy, acknowledged = tmp_path / "copy.journal", []
    for end in np.linspace(0, len(whole), 25).astype(int):
        copy.write_bytes(whole[:end])
        try:
            contents = journal.read(copy)
            recording = assembly.assemble(contents, "fault", "killed")
        except RecordingError as error:
            assert end < 9000, error  # header and plan
            continue
        columns = recording.columns
        assert recording.attributes["outcome"] == ("completed" if contents.ended else "fault")
        told, intents = (sum(kind == of for kind, _ in contents.blocks) for of in (Kind.ACKED, Kind.INTENT))
        assert np.sum(columns["pulses/status"] == PulseStatus.ACKNOWLEDGED) == told
        assert np.sum(np.nan_to_num(columns["pulses/current_ma"]) > 0) == intents
        assert np.sum(np.nan_to_num(columns["pulses/sent_pulse_width_us"]) > 0) == intents
        assert np.all(np.isfinite(columns["torque/time_s"]))
        assert len({len(column) for path, column in columns.items() if path.startswith("pulses/")}) == 1
        acknowledged.append(told)
        archive.to_bytes(recording)
    assert acknowledged == sorted(acknowledged) and acknowledged[-1] > 50
    at = blocks_of(whole, Kind.EXTENSION)
    assert len(at) == 3
    for lost in ([0], [1], [2], [0, 1], [0, 1, 2]):
        spoiled = bytearray(whole)
        for number in lost:
            spoiled[at[number] + 20] ^= 255
        copy.write_bytes(spoiled)
        recording = assembly.assemble(journal.read(copy))
        sent = recording.columns["pulses/sent_pulse_width_us"]
        assert np.nan_to_num(sent)[np.nan_to_num(sent) > 0].tolist() == widths_sent(rig)
        assert "journal is damaged" in recording.attributes["journal_note"]
        if 0 in lost:
            assert "which segments pulses 21 to" in recording.attributes["journal_note"]
            assert "added" not in recording.names


WRONG: dict[str, tuple[list[SegmentPlan], type[RigError], str]] = {
    "too many": ([rest(0.1)] * (MAX_EXTENSION_SEGMENTS + 1), PlanError, "9 segments"),
    "too long": ([rest(MAX_EXTENSION_S), rest(1.0)], RefusedError, "at most 30 s an extension"),
    "an hour": ([SegmentPlan(name="x", sequence="prbs", settings={"chips": 100_000})], RefusedError, "30 s"),
    "wide": ([hold(max_pulse_width_us=281.0)], RefusedError, "hold, pulse 1: pulse_width_us 281 .*profile"),
    "NaN": ([SegmentPlan(name="x", sequence="widths", settings={"pulse_width_us": [math.nan]})], PlanError, "finite"),
    "negative": ([SegmentPlan(name="x", sequence="widths", settings={"pulse_width_us": [-1.0]})], RefusedError, "-1"),
    "no pulse": ([rest(0.001)], PlanError, "too short for one pulse"),
    "one wrong of two": ([rest(0.5), hold(max_pulse_width_us=1e9)], RefusedError, "1e\\+09"),
    "a sudden rise": (
        [SegmentPlan(name="x", sequence="sweep", settings={"from_pulse_width_us": 60.0})], RefusedError, "rise_us 60"
    ),
    "no name": ([SegmentPlan(name="", sequence="rest")], PlanError, "name 1"),
    "a long name": ([SegmentPlan(name="x" * 61, sequence="rest")], PlanError, "name 1"),
    "a name with a NUL": ([SegmentPlan(name="a\0b", sequence="rest")], PlanError, "name 1"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_extension_is_refused_and_lays_nothing(tmp_path: Path, name: str):
    segments, kind, words = WRONG[name]
    rig = adaptive(tmp_path, 60.0, max_pulse_width_us=280.0)
    with pytest.raises(kind, match=words):
        extend(rig, 20, segments)
    assert len(rig.run.score.queue) == 20
    assert Kind.EXTENSION not in {kind for kind, _ in journal.read(rig.path).blocks}


def test_the_dose_is_that_of_the_whole_test(tmp_path: Path):
    """3 s at 6 µC are 720 µC: the third second is refused, and the fixed plan's next is not played after the second."""
    base = limits.tightened(limits.HARD_LIMITS, "charge_per_test_uc", 600.0, "rig file")
    rig = adaptive(tmp_path, base=base, fixed=[rest(0.5), hold("first"), hold("second")])
    extend(rig, 20, [hold("added")])
    with pytest.raises(RefusedError, match=r"charge_per_test_uc 720 .*rig file"):
        extend(rig, 60, [hold("two more"), hold("seconds")])
    result = rig.execute()
    assert (result.summary["ended_by"], result.summary["charge_uc"]) == ("limit", 480.0)
    assert rig.recording().names == ["rest", "added", "first", "rest"]
    told = next(event for event in rig.recording().events if event["event"] == "ended")
    assert "charge_per_test_uc 720" in told["reason"]


def test_the_charge_of_a_second_holds_across_a_boundary(tmp_path: Path):
    base = limits.tightened(limits.HARD_LIMITS, "charge_per_second_uc", 150.0, "rig file")
    half = [rest(1.0), hold("first", on_s=0.5)]
    rig = adaptive(tmp_path, base=base, fixed=half)
    extend(rig, 40, [hold("a", on_s=0.5)])
    with pytest.raises(RefusedError, match="charge_per_second_uc 240"):
        extend(rig, 60, [hold("b", on_s=0.5)])
    extend(rig, 60, [rest(1.0), hold("c", on_s=0.5)])
    assert rig.execute().summary["ended_by"] == "limit"  # the fixed plan's half second would follow one without a pause
    assert rig.recording().names == ["rest", "a", "rest", "c", "rest"]


def test_the_rise_is_counted_from_the_last_pulse_that_is_laid(rig: VirtualRig):
    down = {"from_pulse_width_us": 300.0, "to_pulse_width_us": 120.0}
    extend(rig, 20, [hold("up"), SegmentPlan(name="down", sequence="sweep", settings=down)])
    up = {"from_pulse_width_us": 170.0, "to_pulse_width_us": 300.0}
    extend(rig, 100, [SegmentPlan(name="on", sequence="sweep", settings=up)])
    again = {"from_pulse_width_us": 120.0, "to_pulse_width_us": 171.0}
    extend(rig, 140, [SegmentPlan(name="down", sequence="sweep", settings=again)])
    wide = {"from_pulse_width_us": 222.0, "to_pulse_width_us": 222.0}
    with pytest.raises(RefusedError, match="width_rise_us 51"):
        extend(rig, 180, [SegmentPlan(name="on", sequence="sweep", settings=wide)])


def test_the_bound_of_the_whole_test_holds_with_its_safe_end(tmp_path: Path):
    rig = adaptive(tmp_path, max_duration_s=10.0)
    with pytest.raises(RefusedError, match=r"duration_s 10\.025 .*request"):
        extend(rig, 20, [rest(9.525)])
    with pytest.raises(RefusedError, match=r"with its safe end: duration_s 10\.1"):
        extend(rig, 20, [hold(on_s=8.6)])
    extend(rig, 20, [hold(on_s=8.5)])
    assert rig.run.score.progress(0.0).duration_left_s == pytest.approx(1.0)


def test_a_fixed_plan_that_does_not_fit_its_own_bound_is_refused_before_the_first_pulse(tmp_path: Path):
    with pytest.raises(RefusedError, match=r"with its safe end: duration_s 3\.475 s is outside 0 … 3\.4"):
        adaptive(tmp_path, max_duration_s=3.4)
    (tmp_path / "rested").mkdir()
    assert adaptive(tmp_path / "rested", max_duration_s=3.475).test.longest_s == 3.475
    for wrong in (math.nan, math.inf, 0.0, -1.0):
        with pytest.raises(ValueError, match=r"greater than 0|finite number"):
            AdaptivePlan(max_duration_s=wrong, max_torque_time_nms=1.0)
        with pytest.raises(ValueError, match=r"greater than 0|finite number"):
            AdaptivePlan(max_duration_s=1.0, max_torque_time_nms=wrong)


@pytest.mark.parametrize("pending", ["", "enough", "laid"])
def test_the_measured_torque_time_ends_it_within_a_pulse(tmp_path: Path, pending: str):
    """Neither what is laid far ahead nor an end that waits for its boundary plays on over the bound."""
    rig = adaptive(tmp_path, max_nms=5.0, fixed=[rest(0.5), hold("long", on_s=3.0), hold("more", on_s=3.0)])
    rig.cell.per_block = 10  # the torque of a block counts once it has come
    if pending == "enough":
        rig.at(0.6, lambda: rig.run.score.enough("me", at_once=False))
    if pending == "laid":
        rig.at(0.6, lambda: extend(rig, 140, [hold("ahead", on_s=3.0)]))
    at_end: list[float] = []
    rig.stimulator.on_send = lambda _: at_end.append(rig.run.torque_time_nms)
    result = rig.execute()
    assert (result.outcome, result.summary["ended_by"]) == ("completed", "torque_time")
    a_pulse_nms = 6.0 / PULSES_HZ
    assert at_end[-1] < 5.0 + a_pulse_nms
    assert 5.0 < result.summary["torque_time_nms"] < 5.0 + 2 * a_pulse_nms + 6.0 * 0.1  # the torque falls within 0.1 s
    recording = rig.recording()
    assert recording.names == ["rest", "long", "rest"]
    assert result.summary["duration_s"] == pytest.approx(recording.columns["segments/start_s"][-1] + 1.0, abs=1e-6)


def test_the_torque_time_is_counted_from_rest_and_through_lost_samples(tmp_path: Path):
    rig = adaptive(tmp_path, fixed=[rest(0.5), hold("first", on_s=2.0), rest(2.0)])
    rig.cell.add_nm = -3.0
    rig.at(1.5, lambda: setattr(rig.cell, "skip", 100))
    result = rig.execute()
    assert result.outcome == "completed"
    assert result.summary["torque_time_nms"] == pytest.approx(6.0 * 2.0, rel=0.05)


def test_only_so_many_are_checked_for_one_boundary(rig: VirtualRig):
    wrong = [hold(max_pulse_width_us=1000.0)]
    found = refusals(*[lambda: extend(rig, 20, wrong)] * (MAX_CHECKED + 3), lambda: extend(rig, 20, [hold()]))
    assert [type(error) for error in found] == [RefusedError] * MAX_CHECKED + [BusyError] * 4
    refusals(*[lambda: extend(rig, 19, wrong)] * 100)
    rig.at(0.7, lambda: extend(rig, 60, [hold("added")]))  # the next boundary
    rig.execute()
    assert rig.recording().names == ["rest", "first", "added", "ramp", "rest"]


def mad_segment(rng: np.random.Generator) -> SegmentPlan:
    wide = float(rng.choice([80.0, 200.0, 280.0, 280.5, 281.0, 400.0, 1e9, -1.0], p=[0.3, 0.3, 0.2, *[0.04] * 5]))
    long_s = float(rng.choice([0.001, 0.025, 0.3, 1.0, 5.0, 31.0], p=[0.05, 0.1, 0.4, 0.35, 0.05, 0.05]))
    jumps = bool(rng.random() < 0.7)
    kinds: list[tuple[str, dict[str, Any]]] = [
        ("rest", {"duration_s": long_s}),
        ("steps", {"on_s": long_s, "off_s": 0.1, "repeats": 1, "max_pulse_width_us": wide}),
        ("ramp", {"up_s": long_s, "down_s": 0.1, "max_pulse_width_us": wide}),
        ("sweep", {"from_pulse_width_us": wide, "to_pulse_width_us": 100.0, "duration_s": long_s, "jumps": jumps}),
        ("widths", {"pulse_width_us": [wide] * int(rng.integers(1, 30)), "jumps": jumps}),
        ("prbs", {"bits": int(rng.integers(2, 5)), "clock_pulses": 1, "max_pulse_width_us": wide}),
    ]
    sequence, settings = kinds[int(rng.integers(len(kinds)))]
    return SegmentPlan(name=f"s{rng.integers(100)}", sequence=sequence, settings=settings)


@pytest.mark.parametrize("seed", [1, 2])
def test_whatever_strangers_send_the_whole_test_stays_within_its_limits(tmp_path: Path, seed: int):
    """Right and wrong extensions at random times, some ends among them; judged by arithmetic of its own."""
    rng = np.random.default_rng(1300 + seed)
    base = limits.tightened(limits.HARD_LIMITS, "charge_per_test_uc", 900.0, "rig file")
    base = limits.tightened(base, "charge_per_second_uc", 180.0, "rig file")
    pause = [rest(0.3), hold("a", 0.5, max_pulse_width_us=200.0), rest(0.5), hold("b", 0.5, max_pulse_width_us=150.0)]
    rig = adaptive(tmp_path, 12.0, 60.0, pause, base=base, max_pulse_width_us=280.0)
    score, counts, shown = rig.run.score, {"laid": 0, "refused": 0}, [rig.run.score.queue]

    def ask() -> None:
        before = score.queue
        after = len(before) + int(rng.choice([0, 0, 0, 0, 1, -1, 40]))
        try:
            extend(rig, after, [mad_segment(rng) for _ in range(rng.integers(0, 4))])
        except RigError:
            counts["refused"] += 1
            assert score.queue is before
        else:
            counts["laid"] += 1
            assert np.array_equal(score.queue.pulse_width_us[: len(before)], before.pulse_width_us)
            assert score.queue.segments[: len(before.segments)] == before.segments
        shown.append(score.queue)

    for at_s in np.sort(rng.uniform(-0.1, 12.0, 250)):
        rig.at(float(at_s), ask)
    if seed % 2:
        rig.at(
            float(rng.uniform(3.0, 6.0)), lambda: None if score.ended_by else score.enough("me", bool(seed % 4 == 1))
        )
    result = rig.execute()
    assert result.outcome == "completed", result.reason
    assert counts["laid"] > 3 and counts["refused"] > 10
    times = np.array([time_s for time_s, _ in rig.stimulator.sent])
    sent_us = np.array(widths_sent(rig), dtype=float)
    assert sent_us.max() <= 280
    assert sent_us.sum() * 20e-3 <= 900
    for time_s in times:
        assert sent_us[(times >= time_s) & (times < time_s + 1 - 1e-6)].sum() * 20e-3 <= 180 + 1e-9
    recording = rig.recording()
    planned_us = recording.columns["pulses/pulse_width_us"]
    assert len(planned_us) / PULSES_HZ <= 12.0
    assert np.all(planned_us[-40:] == 0)
    assert np.array_equal(np.floor(planned_us[planned_us >= 1]), sent_us)
    assert len(recording.names) <= 200


def test_a_late_client_costs_rest_and_its_answer_still_counts(tmp_path: Path):
    """A plan that has patience: rest is laid in short pieces, and what was decided before it is laid behind it."""
    rig = adaptive(tmp_path, patience_s=3.0)
    rig.at(1.2, lambda: extend(rig, 20, [hold("added")]))
    rig.at(2.2, lambda: extend(rig, rig.run.score.decided, []))
    rig.execute()
    recording = rig.recording()
    assert recording.names == ["rest", "wait", "wait", "wait", "added", "first", "ramp", "rest"]
    planned_us = recording.columns["pulses/pulse_width_us"]
    assert not planned_us[20:50].any() and planned_us[50:90].all(), "nothing flowed while it waited"


def test_a_client_that_never_comes_back_costs_its_patience_once(tmp_path: Path):
    rig = adaptive(tmp_path, patience_s=0.5)
    rig.execute()
    assert rig.recording().names == ["rest", "wait", "wait", "first", "ramp", "rest"]


def test_patience_is_part_of_the_bounds(tmp_path: Path):
    rig = adaptive(tmp_path, max_duration_s=3.6, patience_s=3.0)
    result = rig.execute()
    assert (result.outcome, result.summary["duration_s"] <= 3.6) == ("completed", True)


KEY = "0123456789abcdef"


def bounded(live: LiveRig, test_id: str = "one", max_duration_s: float = 60.0, **fields: Any) -> TestPlan:
    bounds = AdaptivePlan(max_duration_s=max_duration_s, max_torque_time_nms=1e4)
    return live.plan(test_id, adaptive=bounds, **fields)


def added(on_s: float = 0.5) -> list[SegmentPlan]:
    return [hold("added", on_s, off_s=0.1)]


def request(after: int = 20, test_id: str = "one", key: str = KEY) -> ExtendRequest:
    return ExtendRequest(test_id=test_id, key=key, after=after, segments=added())


def ask_more(live: LiveRig, *which: Any, **key: str) -> Extended:
    return live.ask(live.rig.player.extend(request(*which, **key)))


def test_from_start_to_sealed_file_with_one_that_extends_and_says_enough(live: LiveRig):
    for short in ("", "15 characters!!"):
        with pytest.raises(PlanError, match="at least 16 characters"):
            live.start(bounded(live), short)
    live.start(bounded(live, hold_s=20.0), KEY)
    with pytest.raises(BusyError):
        live.start(bounded(live, "two"), KEY[::-1])  # its key opens nothing
    for wrong in ("", KEY[::-1], KEY[:-1], KEY + "0", "0123456789abcdeF", "\ud800" * 16):
        with pytest.raises(PlanError, match="not the key"):
            ask_more(live, 20, key=wrong)
    for ask in (
        lambda: ask_more(live, 20, "two"),
        lambda: live.ask(live.rig.player.enough(EnoughRequest(test_id="two"))),
    ):
        with pytest.raises(TooLateError, match="test 'two' is not running"):
            ask()
    first = ask_more(live, 20)
    assert (first.laid, first.boundary_s, first.ended_by) == (44, 1.1, "")
    assert first.duration_left_s == pytest.approx(60 - 1.1)
    live.wait("running")
    live.wait_pulses(5)
    assert ask_more(live, 44).laid == 68
    event = live.event()
    assert event is not None
    assert (event.laid, event.boundary_s, event.duration_s) == (68, 1.7, 60.0)
    assert [(s.name, s.by) for s in event.laid_segments] == [("rest", "plan"), *[("added", "extension")] * 2]
    rows = np.array(list(event.torque_rows()))
    assert np.all(np.diff(rows[:, 3]) == 1) and np.all(np.isfinite(rows[:, [0, 2]]))
    told = event.outcomes
    assert told.index == list(range(len(told.index))) and len(told.index) > 20
    assert told.status == [1] * 20 + [0] * (len(told.index) - 20)
    assert all(a < b for a, b in zip(told.written_time_s, told.acknowledged_time_s, strict=True) if a and b)
    assert LiveEvent.model_validate(json.loads(event.model_dump_json())) == event, "read as it was sent"
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


def test_a_fixed_test_and_a_calibration_are_not_extended(live: LiveRig):
    live.start(live.plan("one", hold_s=20.0), KEY)
    for ask in (lambda: ask_more(live, 840), lambda: live.ask(live.rig.player.enough(EnoughRequest(test_id="one")))):
        with pytest.raises(PlanError, match="fixed plan"):
            ask()


def test_the_rest_between_tests_is_counted_to_the_first_pulse_that_may_come(live: LiveRig):
    """The fixed plan would not stimulate for a minute, an extension might after half a second."""
    live.play("before", hold_s=0.5)
    rested = Profile(rest_between_tests_s=30.0)
    quiet = [rest(0.5), rest(60.0)]
    assert live.start(live.plan("fixed", profile=rested, segments=[*quiet, *added()])).state == "arming"
    live.stop("that was only to show it")
    live.wait("latched")
    live.rearm()
    with pytest.raises(RefusedError, match=r"rest_between_tests_s .*wait 2\d"):
        live.start(bounded(live, profile=rested, segments=[*quiet, *added()], max_duration_s=90.0), KEY)


def test_the_day_must_last_as_long_as_the_bound(live: LiveRig):
    midnight_s = end_of_day_s(live.clock.unix_s())
    live.clock.set_unix_ahead(midnight_s - 10.0 - live.clock.unix_s())
    day = Profile(
        sensory_pulse_width_us=20.0, motor_pulse_width_us=60.0,
        set_at_utc=utc_text(midnight_s - 3600), expires_at_utc=utc_text(midnight_s),
    )  # fmt: skip
    late = bounded(live, profile=day, max_duration_s=60.0)
    with pytest.raises(RefusedError, match="before the end of this test of 15 s"):
        live.start(late, KEY)
    with pytest.raises(RefusedError, match="before the end of this test of 15 s"):
        live.preview(late)
    assert live.start(bounded(live, profile=day, max_duration_s=30.0), KEY).state == "arming"


def test_until_a_tests_clock_runs_nothing_is_told_of_it(live: LiveRig):
    """Its samples have no time on it yet, and the gate still holds what became of the last test's pulses."""
    live.play("before", hold_s=0.5)
    live.start(live.plan("one", hold_s=2.0))
    told = []
    while not told or told[-1].test_id is None:
        live.machine.wait(0.002)
        told += [event for event in [live.event()] if event is not None]
        assert live.clock.now_s() < 1e5
    assert {event.test_id for event in told[:-1]} <= {None}
    assert all(event.outcomes.index == [] for event in told[:-1])
    live.wait_pulses(20)
    live.machine.wait(0.3)
    rest = live.event()
    outcomes = [event.outcomes for event in (told[-1], rest) if event is not None]
    index = [number for one in outcomes for number in one.index]
    assert index == list(range(len(index))) and len(index) >= 20, "each of its own pulses, once"

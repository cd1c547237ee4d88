"""A test that is extended while it plays: no extension, right or wrong, takes it beyond a limit of the whole."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stimrig.rig import journal, limits
from stimrig.rig.errors import BusyError, PlanError, RefusedError, RigError
from stimrig.rig.journal import Kind
from stimrig.rig.messages import AdaptivePlan, SegmentPlan
from stimrig.rig.score import MAX_CHECKED, MAX_EXTENSION_S, MAX_EXTENSION_SEGMENTS
from tests.rig.adaptive import RATE_HZ, adaptive, extend, hold, refusals, rest, widths_sent

WRONG: dict[str, tuple[list[SegmentPlan], type[RigError], str]] = {
    "nothing": ([], PlanError, "0 segments; give 1 to 8"),
    "too many": ([rest(0.1)] * (MAX_EXTENSION_SEGMENTS + 1), PlanError, "9 segments"),
    "ten thousand": ([rest(0.1)] * 10_000, PlanError, "10000 segments"),
    "too long": ([rest(MAX_EXTENSION_S), rest(1.0)], RefusedError, "at most 30 s an extension"),
    "an hour": ([SegmentPlan(name="x", sequence="prbs", settings={"chips": 100_000})], RefusedError, "30 s"),
    "wide": ([hold(max_pulse_width_us=281.0)], RefusedError, "hold, pulse 1: pulse_width_us 281 .*profile"),
    "NaN": ([SegmentPlan(name="x", sequence="widths", settings={"pulse_width_us": [math.nan]})], PlanError, "finite"),
    "infinite": ([SegmentPlan(name="x", sequence="sweep", settings={"to_pulse_width_us": math.inf})], PlanError, "fin"),
    "negative": ([SegmentPlan(name="x", sequence="widths", settings={"pulse_width_us": [-1.0]})], RefusedError, "-1"),
    "a text": ([SegmentPlan(name="x", sequence="rest", settings={"duration_s": "1"})], PlanError, "duration_s"),
    "no such sequence": ([SegmentPlan(name="x", sequence="os", settings={})], PlanError, "unknown"),
    "no pulse": ([rest(0.001)], PlanError, "too short for one pulse"),
    "one wrong of two": ([rest(0.5), hold(max_pulse_width_us=1e9)], RefusedError, "1e\\+09"),
    "a sudden rise": (
        [SegmentPlan(name="x", sequence="sweep", settings={"from_pulse_width_us": 60.0})], RefusedError, "rise_us 60"
    ),
    "no name": ([SegmentPlan(name="", sequence="rest")], PlanError, "name 1"),
    "a long name": ([SegmentPlan(name="x" * 61, sequence="rest")], PlanError, "name 1"),
    "a name with a NUL": ([SegmentPlan(name="a\0b", sequence="rest")], PlanError, "name 1"),
    "a name with a line's end": ([SegmentPlan(name="a\nb", sequence="rest")], PlanError, "name 1"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_extension_is_refused_and_lays_nothing(tmp_path: Path, name: str):
    segments, kind, words = WRONG[name]
    rig = adaptive(tmp_path, 60.0, max_pulse_width_us=280.0)
    with pytest.raises(kind, match=words):
        extend(rig, 20, segments)
    assert len(rig.run.score.laid) == 20
    assert Kind.LAID not in {kind for kind, _ in journal.read(rig.path).blocks}


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


def test_the_rise_is_counted_from_the_last_pulse_that_is_laid(tmp_path: Path):
    rig = adaptive(tmp_path)
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
    assert rig.run.score.left(0.0).duration_left_s == pytest.approx(1.0)


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
    if pending == "enough":
        rig.at(0.6, lambda: rig.run.score.enough("me", at_once=False))
    if pending == "laid":
        rig.at(0.6, lambda: extend(rig, 140, [hold("ahead", on_s=3.0)]))
    at_end: list[float] = []
    rig.stimulator.on_send = lambda _: at_end.append(rig.run.torque_time_nms)
    result = rig.execute()
    assert (result.outcome, result.summary["ended_by"]) == ("completed", "torque_time")
    a_pulse_nms = 6.0 / RATE_HZ
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


def test_only_so_many_are_checked_for_one_boundary(tmp_path: Path):
    rig = adaptive(tmp_path)
    wrong = [hold(max_pulse_width_us=1000.0)]
    found = refusals(*[lambda: extend(rig, 20, wrong)] * (MAX_CHECKED + 3), lambda: extend(rig, 20, [hold()]))
    assert [type(error) for error in found] == [RefusedError] * MAX_CHECKED + [BusyError] * 4
    refusals(*[lambda: extend(rig, 19, wrong)] * 100)
    rig.at(0.7, lambda: extend(rig, 60, [hold("added")]))  # the next boundary
    rig.execute()
    assert rig.recording().names == ["rest", "first", "added", "ramp", "rest"]


def mad_segment(rng: np.random.Generator) -> SegmentPlan:
    """One of the library's segments, most of them within the limits."""
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_whatever_strangers_send_the_whole_test_stays_within_its_limits(tmp_path: Path, seed: int):
    """Right and wrong extensions at random times, some ends among them; judged by arithmetic of its own."""
    rng = np.random.default_rng(1300 + seed)
    base = limits.tightened(limits.HARD_LIMITS, "charge_per_test_uc", 900.0, "rig file")
    base = limits.tightened(base, "charge_per_second_uc", 180.0, "rig file")
    pause = [rest(0.3), hold("a", 0.5, max_pulse_width_us=200.0), rest(0.5), hold("b", 0.5, max_pulse_width_us=150.0)]
    rig = adaptive(tmp_path, 12.0, 60.0, pause, base=base, max_pulse_width_us=280.0)
    score, counts, shown = rig.run.score, {"laid": 0, "refused": 0}, [rig.run.score.laid]

    def ask() -> None:
        before = score.laid
        after = len(before) + int(rng.choice([0, 0, 0, 0, 1, -1, 40]))
        try:
            extend(rig, after, [mad_segment(rng) for _ in range(rng.integers(0, 4))])
        except RigError:
            counts["refused"] += 1
            assert score.laid is before
        else:
            counts["laid"] += 1
            assert np.array_equal(score.laid.pulse_width_us[: len(before)], before.pulse_width_us)
            assert score.laid.segments[: len(before.segments)] == before.segments
        shown.append(score.laid)

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
    assert len(planned_us) / RATE_HZ <= 12.0
    assert np.all(planned_us[-40:] == 0)
    assert np.array_equal(np.floor(planned_us[planned_us >= 1]), sent_us)
    assert len(recording.names) <= 200

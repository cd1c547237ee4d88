"""A computer that stands still in a test: up to a second is a gap; more, too often or a doubt is a fault."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stimrig.rig.acquire.health import DEFAULT_WATCH
from stimrig.rig.acquire.pauses import LONGEST_S, RECOVERY_S
from stimrig.rig.messages import SegmentPlan
from stimrig.rig.signals import PulseStatus
from tests.rig.fakes import BEGINS_S, PULSES_HZ, VirtualRig, hold

JUMPING = {"name": "prbs", "sequence": "prbs", "settings": {}}
BEGAN_S = 1.2
LATE_S = DEFAULT_WATCH.late_pulse_periods / PULSES_HZ
"""A pulse that is due so shortly before the end of a pause is still sent."""


def paused(rig: VirtualRig, *standstills: tuple[float, float]) -> None:
    """The whole computer stands still so long at these times; what the cell sends meanwhile waits in a buffer."""
    for at_s, for_s in standstills:
        rig.at(at_s, lambda for_s=for_s: rig.clock.advance(for_s))


@pytest.fixture
def rig(tmp_path: Path) -> VirtualRig:
    found = VirtualRig(tmp_path, [hold(on_s=6.0)])
    found.cell.noise_nm = 0.01
    return found


@pytest.mark.parametrize("for_s", [0.12, 0.3, 0.8, 0.99])
def test_a_standstill_of_up_to_a_second_is_a_gap(rig: VirtualRig, for_s: float):
    paused(rig, (BEGAN_S, for_s))
    result = rig.execute()
    assert (result.outcome, result.reason) == ("completed", "")
    recording = rig.recording()
    (pause,) = result.summary["pauses"]
    assert pause["blocked_s"] == pytest.approx(for_s, abs=0.03)
    assert for_s <= pause["for_s"] <= for_s + RECOVERY_S
    assert pause["at_s"] == pytest.approx(BEGAN_S, abs=0.03)
    events = [event for event in recording.events if event["event"] == "pause"]
    assert [event["for_s"] for event in events] == [pause["for_s"]], "it is kept in the recording"
    planned_s = recording.columns["pulses/planned_time_s"]
    gap = (planned_s >= pause["at_s"] - 1e-6) & (planned_s < pause["at_s"] + pause["for_s"] - LATE_S)
    assert np.all(recording.columns["pulses/status"][gap] == PulseStatus.DROPPED)
    assert np.all(recording.columns["pulses/status"][~gap] == PulseStatus.ACKNOWLEDGED)
    assert rig.stimulator.sent[-1][0] - rig.stimulator.sent[0][0] == pytest.approx(6.0 - 0.025), "its clock went on"


@pytest.mark.parametrize("sequence", [SegmentPlan(**JUMPING), hold(on_s=6.0)])
def test_after_it_the_width_climbs_from_nothing_also_where_the_sequence_jumps(tmp_path: Path, sequence: SegmentPlan):
    rig = VirtualRig(tmp_path, [sequence])
    rig.cell.noise_nm = 0.01
    paused(rig, (BEGAN_S, 0.5))
    assert rig.execute().outcome == "completed"
    times = np.array([time_s for time_s, _ in rig.stimulator.sent])
    widths_us = np.array([pulse.pulse_width_us for _, pulse in rig.stimulator.sent])
    after = int(np.argmax(np.diff(times))) + 1
    assert times[after] - times[after - 1] > 0.5
    climbing = np.r_[0, widths_us[after : after + 3]]
    assert np.all(np.diff(climbing) <= 50) and climbing[1] > 0


Fault = Callable[[VirtualRig], object]
DOUBTS: dict[str, tuple[Fault, str]] = {
    "longer than a second": (lambda r: r.clock.advance(LONGEST_S + 0.03), "the computer was blocked for 1.0 s"),
    "a cell that stays silent": (
        lambda r: (setattr(r.cell, "silent", True), r.clock.advance(0.4)), "silent for 1 s"),
    "a cell that was silent before": (
        lambda r: (setattr(r.cell, "silent", True), r.at(-BEGINS_S + 0.15, lambda: r.clock.advance(0.4))), "stale"),
    "a cell that counts on another clock": (
        lambda r: (setattr(r.cell, "skip", -1200), r.clock.advance(0.4)), "in order again"),
    "no acknowledgement of the last pulse": (
        lambda r: (setattr(r.stimulator, "ack_delay_s", None), r.at(-BEGINS_S + 0.03, lambda: r.clock.advance(0.4))),
        "not acknowledged"),
    "a stimulator that started anew": (
        lambda r: (setattr(r.stimulator, "armed", False), r.clock.advance(0.4)), "not initialised after a pause"),
    "a stimulator that does not answer": (
        lambda r: (setattr(r.stimulator, "silent", True), r.clock.advance(0.4)), "no answer"),
    "a torque beyond its limit meanwhile": (
        lambda r: (setattr(r.cell, "add_nm", 35.0), r.clock.advance(0.4)), "outside -30 … 30"),
}  # fmt: skip


@pytest.mark.parametrize("name", DOUBTS)
def test_what_is_not_whole_after_it_ends_the_test_and_nothing_is_sent(rig: VirtualRig, name: str):
    inject, words = DOUBTS[name]
    rig.at(BEGAN_S, lambda: inject(rig))
    began_s = rig.clock.now_s() + BEGINS_S + BEGAN_S
    result = rig.execute()
    assert result.outcome == "fault"
    assert words in result.reason, result.reason
    assert rig.stimulator.sent[-1][0] <= began_s + 0.15
    assert rig.stimulator.stops >= 1


def test_long_ones_again_and_again_end_the_test(rig: VirtualRig):
    paused(rig, (1.0, 0.95), (2.5, 0.95), (4.0, 0.95))
    result = rig.execute()
    assert (result.outcome, len(result.summary["pauses"])) == ("fault", 2)
    assert "blocked 3 times within 10 s" in result.reason


def test_short_ones_again_and_again_do_not(rig: VirtualRig):
    paused(rig, *((0.5 + 0.5 * number, 0.2) for number in range(9)))
    result = rig.execute()
    assert (result.outcome, len(result.summary["pauses"])) == ("completed", 9), result.reason


def test_one_that_follows_before_all_is_whole_is_part_of_it(rig: VirtualRig):
    paused(rig, (BEGAN_S, 0.5), (BEGAN_S + 0.55, 0.5))
    result = rig.execute()
    (pause,) = result.summary["pauses"]
    assert result.outcome == "completed" and 1.05 <= pause["for_s"] <= 1.2 and pause["blocked_s"] < 0.55


def test_no_current_comes_back_after_a_series_of_them_without_end(rig: VirtualRig):
    paused(rig, *((BEGAN_S + 0.33 * number, 0.3) for number in range(12)))
    result = rig.execute()
    assert result.outcome == "fault" and result.summary["pauses"] == []
    assert rig.stimulator.sent[-1][0] < 1000.0 + BEGINS_S + 0.005 + BEGAN_S


@pytest.mark.parametrize("for_s", [0.07, 0.095])
def test_many_that_are_too_short_for_a_pause_make_no_strong_pulse_on_a_rested_muscle(tmp_path: Path, for_s: float):
    rig = VirtualRig(tmp_path, [hold(on_s=6.0)])
    rig.cell.noise_nm = 0.01
    paused(rig, *((3.0125 + 0.1 * number, for_s) for number in range(20)))
    result = rig.execute()
    assert result.outcome == "completed"
    times = np.array([time_s for time_s, _ in rig.stimulator.sent])
    widths_us = np.array([pulse.pulse_width_us for _, pulse in rig.stimulator.sent])
    after = np.flatnonzero(np.diff(times) > 0.12) + 1
    assert np.all(widths_us[after] <= 50)


@pytest.mark.parametrize("answers_s", [0.45, 5.0])
def test_who_stops_waits_for_no_answer_of_the_stimulator(rig: VirtualRig, answers_s: float):
    slow_to_tell(rig, answers_s)
    stop_s = BEGINS_S + BEGAN_S + 0.4 + 0.25
    rig.at(stop_s - BEGINS_S, lambda: rig.halt.set("stopped", "enough"))
    paused(rig, (BEGAN_S, 0.4))
    assert rig.execute().outcome == "stopped"
    assert rig.stimulator.stopped_s[0] - (1000.0 + stop_s) < 0.02
    assert rig.stimulator.sent[-1][0] < 1000.0 + BEGINS_S + BEGAN_S + 0.01


def test_a_cell_that_dies_while_the_stimulator_is_asked_ends_the_test_without_a_pulse(rig: VirtualRig):
    slow_to_tell(rig, 0.45)
    rig.at(BEGAN_S + 0.5, lambda: setattr(rig.cell, "silent", True))
    paused(rig, (BEGAN_S, 0.4))
    result = rig.execute()
    assert result.outcome == "fault" and "torque is stale" in result.reason
    assert rig.stimulator.sent[-1][0] < 1000.0 + BEGINS_S + BEGAN_S + 0.01


def slow_to_tell(rig: VirtualRig, answers_s: float) -> None:
    state = rig.stimulator.state

    async def later() -> tuple[bool, str]:
        if rig.stimulator.sent and not rig.halt.cause:
            await rig.machine.tasks.sleep(answers_s)
        return await state()

    rig.stimulator.state = later


@pytest.mark.parametrize("cause", ["stopped", "withdrawn"])
def test_who_stops_during_it_is_heard_before_the_next_pulse(rig: VirtualRig, cause: str):
    """What came while it stood still is taken first; also where it comes while all is looked at anew."""
    for after_s in (0.0, 0.05):
        rig.at(BEGAN_S + 0.4 + after_s, lambda: rig.halt.set(cause, "enough"))
    paused(rig, (BEGAN_S, 0.4))
    began_s = rig.clock.now_s() + BEGINS_S + BEGAN_S
    assert rig.execute().outcome == "stopped"
    assert rig.stimulator.sent[-1][0] <= began_s


def test_nothing_is_sent_nor_fed_before_all_is_whole(rig: VirtualRig):
    """A backlog is read first: torque from before the pause is not torque of now."""
    rig.cell.held = lambda now_s: BEGAN_S + BEGINS_S < now_s - 1000.0 < BEGAN_S + BEGINS_S + 0.55
    paused(rig, (BEGAN_S, 0.3))
    result = rig.execute()
    assert result.outcome == "completed", result.reason
    whole_s = 1000.0 + BEGINS_S + BEGAN_S + 0.55
    assert not [time_s for time_s, _ in rig.stimulator.sent if whole_s - 0.5 < time_s < whole_s]
    assert not [time_s for time_s in rig.stimulator.fed_s if whole_s - 0.5 < time_s < whole_s]

"""Before the first pulse: a load cell that gives nothing, or nothing of now, is noticed and told, and nothing is felt.

A good cell is never refused, also one that is coarse and stands still at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stimrig.rig.acquire.health import DEFAULT_WATCH, Watch
from stimrig.rig.acquire.run import RunResult
from stimrig.rig.acquire.stream import LOOK_AT
from stimrig.rig.config import EMULATOR_WATCH
from stimrig.rig.signals import SAMPLE, Block
from tests.rig.fakes import VirtualRig, hold, rest, void

EMULATOR = Watch.model_validate(EMULATOR_WATCH)
SILENT, STANDS, ERRORS = "load cell", "has given exactly ", "reports errors of the bus"


def errors_for(rig: VirtualRig, for_s: float) -> None:
    """Error frames, one each 10 ms; nothing is lost."""
    for number in range(int(for_s / 0.01)):
        at_s = rig.clock.now_s() + 0.01 * number
        rig.clock.call_at(at_s, lambda: rig.receiver.add(Block(np.empty(0, SAMPLE), error_frames=1)))


def repeat_frames(rig: VirtualRig) -> None:
    """The adapter gives the same frames again and again: their counter stands still."""
    counter = rig.cell.counter
    rig.clock.call_at(rig.clock.now_s(), lambda: again(rig, counter))


def again(rig: VirtualRig, counter: int) -> None:
    rig.cell.counter = counter - rig.cell.per_block
    rig.clock.call_at(rig.clock.now_s() + 0.001, lambda: again(rig, counter))


FAULTS: dict[str, tuple[Callable[[VirtualRig], object], str]] = {
    "silent": (lambda rig: setattr(rig.cell, "silent", True), SILENT),
    "the same frames": (repeat_frames, SILENT),
    "the bridge without its plug": (lambda rig: setattr(rig.cell, "frozen", True), STANDS),
    "at the end of its range": (lambda rig: rig.cell.__dict__.update(frozen=True, last_nm=4.9), STANDS),
    "bus errors": (lambda rig: errors_for(rig, 9.0), ERRORS),
}  # fmt: skip


def rig_of(folder: Path, rest_s: float = 0.0, watch: Watch = DEFAULT_WATCH, noise_nm: float = 0.03) -> VirtualRig:
    rig = VirtualRig(folder, [*([rest(rest_s)] if rest_s else []), hold(on_s=1.0)], watch)
    rig.cell.noise_nm = noise_nm
    return rig


def play(rig: VirtualRig, idle_s: float, *events: tuple[float, Callable[[], object]]) -> RunResult:
    """Connect the cell, let it idle, then start the test; `events` come so long before the start."""
    rig.machine.run(rig.receiver.open())
    for before_s, action in events:
        rig.clock.call_at(rig.clock.now_s() + idle_s - before_s, lambda action=action: void(action()))
    rig.clock.wait(rig.machine.tasks, idle_s)
    return rig.machine.run(rig.run.execute())


MOMENTS = [
    *((DEFAULT_WATCH, 0.0, before_s) for before_s in (0.9, 0.3, 0.08, 0.0)),
    *((DEFAULT_WATCH, 1.0, left_s - 1.105) for left_s in (0.9, 0.4, 0.12)),
    (EMULATOR, 0.0, 0.08),
    (EMULATOR, 1.0, -0.705),
]
"""The watch, how long the test rests first, and how long before its start the cell fails (negative: after it)."""


EVERYWHERE = "silent", "the bridge without its plug"
CASES = [(name, *at) for name in FAULTS for at in (MOMENTS if name in EVERYWHERE else MOMENTS[::2])]


@pytest.mark.parametrize(("name", "watch", "rest_s", "before_s"), CASES)
def test_a_cell_that_fails_before_the_first_pulse_is_told_and_no_pulse_is_sent(
    tmp_path: Path, name: str, watch: Watch, rest_s: float, before_s: float
):
    rig = rig_of(tmp_path, rest_s, watch=watch)
    inject, words = FAULTS[name]
    if words == STANDS and not rest_s:
        before_s += 0.02  # until it has stood still for 0.1 s nobody can know
    result = play(rig, 3.0, (before_s, lambda: inject(rig)))
    assert (result.outcome, rig.stimulator.sent) == ("fault", [])
    told = words in result.reason and LOOK_AT in result.reason
    assert told or (rest_s and (LOOK_AT in result.reason or "it is stuck" in result.reason)), result.reason


@pytest.mark.parametrize("before_s", [2.9, 30.0])
def test_a_plug_that_was_pulled_long_before_is_told_as_well(tmp_path: Path, before_s: float):
    rig = rig_of(tmp_path)
    result = play(rig, before_s + 2.0, (before_s, lambda: setattr(rig.cell, "frozen", True)))
    assert (result.outcome, rig.stimulator.sent) == ("fault", [])
    assert f"{STANDS}" in result.reason and f" for {before_s:.1f} s: {LOOK_AT}" in result.reason


def test_a_contact_that_bounces_before_it_is_lost_is_no_quiet_cell(tmp_path: Path):
    rig = rig_of(tmp_path)
    bounces = [(1.5 - 0.03 * n, lambda n=n: setattr(rig.cell, "frozen", n % 2 == 0)) for n in range(11)]
    result = play(rig, 3.0, *bounces)
    assert (result.outcome, rig.stimulator.sent) == ("fault", [])
    assert STANDS in result.reason


def test_a_cell_that_never_gave_another_value_is_told_with_what_to_try(tmp_path: Path):
    rig = rig_of(tmp_path, noise_nm=0.0)
    result = play(rig, DEFAULT_WATCH.unmoved_torque_s + 0.5)
    assert (result.outcome, rig.stimulator.sent) == ("fault", [])
    assert "since it was connected: pull at it, the value must follow" in result.reason


GOOD: dict[str, tuple[float, float, Watch]] = {
    "noise": (0.03, 0.0, DEFAULT_WATCH),
    "coarse, some noise": (0.02, 0.1, DEFAULT_WATCH),
    "coarse, restless": (0.04, 0.1, DEFAULT_WATCH),
    "coarse, quiet": (0.001, 0.1, DEFAULT_WATCH),
    "no noise, not moved for long on the emulator": (0.0, 0.0, EMULATOR),
}


@pytest.mark.parametrize("name", GOOD)
def test_a_good_cell_is_not_refused_also_where_it_stands_still(tmp_path: Path, name: str):
    noise_nm, step_nm, watch = GOOD[name]
    rig = rig_of(tmp_path, watch=watch, noise_nm=noise_nm)
    rig.cell.step_nm = step_nm
    moved = [] if watch is EMULATOR else [  # the limb is put in, and lies still
        (9.0 - 0.2 * n, lambda n=n: setattr(rig.cell, "add_nm", 0.15 * n)) for n in range(8)
    ]  # fmt: skip
    result = play(rig, 14.0, *moved)
    assert result.outcome == "completed", result.reason
    assert result.summary["dropped_pulses"] == 0


def test_a_single_bus_error_delays_a_start_and_does_not_refuse_it(tmp_path: Path):
    rig = rig_of(tmp_path)
    result = play(rig, 3.0, (0.02, lambda: errors_for(rig, 0.01)))
    assert (result.outcome, result.summary["dropped_pulses"]) == ("completed", 0)
    assert rig.stimulator.sent[0][0] - 1003.0 > 0.1 + 0.1 - 0.02


@pytest.mark.parametrize("at_s", [0.05, 0.095])  # it is armed, and its first pulse is due after 0.1 s
def test_a_computer_that_stands_still_has_not_waited_for_the_cell(tmp_path: Path, at_s: float):
    rig = rig_of(tmp_path)
    rig.clock.call_at(1003.0 + at_s, lambda: rig.clock.advance(0.8))
    rig.cell.held = lambda now_s: 0.0 < now_s - (1003.0 + at_s) < 0.82  # what waits is read a moment later
    result = play(rig, 3.0)
    assert result.outcome == "completed", result.reason


@pytest.mark.parametrize("for_s", [3.0, 3600.0])  # a laptop that slept, too
def test_a_start_that_a_computer_slept_through_plays_nothing(tmp_path: Path, for_s: float):
    rig = rig_of(tmp_path)
    rig.clock.call_at(1003.03, lambda: rig.clock.advance(for_s))
    rig.cell.held = lambda now_s: 1002.9 < now_s < 1003.05 + for_s  # so that it waits for the cell meanwhile
    result = play(rig, 3.0)
    assert result.outcome == "fault" and "blocked" in result.reason and rig.stimulator.sent == []

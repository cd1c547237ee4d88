"""Faults of the load cell, its adapter and the CAN bus."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable

from stimrig.hardware_sim.errors import FaultError
from stimrig.hardware_sim.faults import (
    Target,
    Undo,
    at_another_rate,
    check_not_negative,
    fault,
    frames_sometimes,
    hooked,
    replaced,
    sometimes,
    stuck,
)
from stimrig.hardware_sim.load_cells.frames import Frame, Sample

BUS_OFF_CLASS, BUS_ERROR_CLASS = 0x20000040, 0x20000080
"""Ids of error frames as Linux reports them: the flag of error frames and the class."""


@fault
def cell_silent(target: Target) -> Undo:
    """No frame comes any more; the connection stays."""
    return hooked(lambda _frame: (), target.load_cell.frame_hooks)


@fault
def cell_unplugged(target: Target) -> Undo:
    """The adapter is pulled. When undone, it is back under another port, and clients must connect again."""
    target.plug_cell(False)
    return target.plug_cell


@fault
def frames_dropped(target: Target, probability: float = 0.1) -> Undo:
    """Frames are lost at random."""
    return _frame_fault(target, probability, lambda _frame: ())


@fault
def frames_duplicated(target: Target, probability: float = 0.1) -> Undo:
    """Frames come twice at random."""
    return _frame_fault(target, probability, lambda frame: (frame, frame))


@fault
def frames_out_of_order(target: Target, probability: float = 0.1) -> Undo:
    """At random a frame comes after the one that follows it."""
    delayed: list[Frame] = []

    def swap(frame: Frame) -> Iterable[Frame]:
        if delayed:
            return (frame, delayed.pop())
        if target.random.random() < probability:
            delayed.append(frame)
            return ()
        return (frame,)

    return hooked(swap, target.load_cell.frame_hooks)


@fault
def frames_corrupt(target: Target, probability: float = 0.1) -> Undo:
    """One bit of a frame's data flips at random: a fault of the adapter, since CAN's CRC would catch it."""

    def flip(frame: Frame) -> Iterable[Frame]:
        if frame.error or not frame.data or target.random.random() >= probability:
            return (frame,)
        data = bytearray(frame.data)
        data[target.random.randrange(len(data))] ^= 1 << target.random.randrange(8)
        return (frame._replace(data=bytes(data)),)

    return hooked(flip, target.load_cell.frame_hooks)


@fault
def torque_stuck(target: Target) -> Undo:
    """The reading stays at its present value, without noise; the counter goes on."""
    return hooked(stuck(), target.load_cell.torque_hooks)


@fault
def torque_nan(target: Target, probability: float = 1.0) -> Undo:
    """The reading is not a number."""
    return hooked(sometimes(target, probability, lambda _torque_nm: math.nan), target.load_cell.torque_hooks)


@fault
def torque_sign_flipped(target: Target) -> Undo:
    """The cell is mounted the other way round."""
    return hooked(lambda torque_nm, _time_s: -torque_nm, target.load_cell.torque_hooks)


@fault
def torque_saturated(target: Target, limit_nm: float = 3.0) -> Undo:
    """The amplifier saturates at ± `limit_nm`."""
    limited = lambda torque_nm, _time_s: min(max(torque_nm, -limit_nm), limit_nm)  # noqa: E731
    return hooked(limited, target.load_cell.torque_hooks)


@fault
def torque_step(target: Target, step_nm: float = 40.0) -> Undo:
    """The reading jumps: a knock on the fixture, or a spasm above the limit."""
    return hooked(lambda torque_nm, _time_s: torque_nm + step_nm, target.load_cell.torque_hooks)


@fault
def bus_off(target: Target) -> Undo:
    """The adapter reports bus-off once, then nothing comes."""
    now_s = target.timeline.now_s
    target.load_cell.add_frame(Frame(BUS_OFF_CLASS, bytes(8), target.load_cell.clock.time_us(now_s), True, now_s))
    return _hooked_on_bus(target, lambda _frame: ())


@fault
def error_frames(target: Target, probability: float = 0.1) -> Undo:
    """Error frames come between the others; nothing is lost."""
    return _frame_fault(
        target, probability, lambda frame: (frame, frame._replace(can_id=BUS_ERROR_CLASS, data=bytes(8), error=True))
    )


@fault
def counter_jump(target: Target, step: int = 1000) -> Undo:
    """The counter jumps once; no sample is lost."""
    target.load_cell.counter += int(step)
    return lambda: None


@fault
def rate_off(target: Target, percent: float = 5.0) -> Undo:
    """The cell samples faster than nominal, or slower if `percent` is negative."""
    return at_another_rate(target.load_cell.clock, percent)


@fault
def clock_jitter(target: Target, sd_us: float = 100.0) -> Undo:
    """Each sample is taken off its time at random, never by more than 0.45 of a period."""
    check_not_negative("clock_jitter", "sd_us", sd_us)
    before_s = target.load_cell.clock.jitter_s
    target.load_cell.clock.set_jitter(sd_us * 1e-6)
    return lambda: target.load_cell.clock.set_jitter(before_s)


@fault
def delivery_jitter(target: Target, largest_s: float = 0.02) -> Undo:
    """A busy adapter: frames come up to `largest_s` late at random, in order and with their own time stamps."""
    check_not_negative("delivery_jitter", "largest_s", largest_s)
    waiting: deque[Frame] = deque()
    last_s = 0.0

    def release() -> None:
        if waiting:
            frame = waiting.popleft()
            target.load_cell.add_frame(frame._replace(time_s=min(frame.time_s, target.timeline.now_s)))

    def delay(frame: Frame) -> Iterable[Frame]:
        nonlocal last_s
        last_s = max(last_s, frame.time_s + target.random.uniform(0.0, largest_s))
        waiting.append(frame._replace(time_s=last_s))
        target.timeline.at(last_s, release)
        return ()

    unhook = _hooked_on_bus(target, delay)

    def undo() -> None:
        unhook()
        while waiting:  # otherwise they would come after newer ones
            release()

    return undo


@fault
def wrong_bit_rate(target: Target) -> Undo:
    """The adapter listens at another bit rate: instead of frames it reports errors of the bus."""
    return _hooked_on_bus(target, lambda frame: (_error_instead(frame),))


@fault
def termination_missing(target: Target, probability: float = 0.2) -> Undo:
    """A resistor at the bus's end is missing: frames are lost at random, and errors of the bus come instead."""
    return _frame_fault(target, probability, lambda frame: (_error_instead(frame),))


@fault
def hung_weight(target: Target, torque_nm: float = 5.0) -> Undo:
    """A weight hangs on the lever. It acts on the cell before every other fault of the reading does."""
    hooks = target.load_cell.torque_hooks
    hang = lambda reading_nm, _time_s: reading_nm + torque_nm  # noqa: E731
    hooks.insert(0, hang)
    return lambda: hooks.remove(hang)


@fault
def torque_noisy(target: Target, sd_nm: float = 1.0) -> Undo:
    """More noise comes to the reading: a loose shield, mains hum."""
    check_not_negative("torque_noisy", "sd_nm", sd_nm)
    noisy = lambda torque_nm, _time_s: torque_nm + target.random.gauss(0.0, sd_nm)  # noqa: E731
    return hooked(noisy, target.load_cell.torque_hooks)


@fault
def counter_stuck(target: Target) -> Undo:
    """The counter stands still; the readings go on."""
    stands_at = target.load_cell.counter
    return _repacked(target, lambda sample: sample._replace(counter=stands_at))


@fault
def sync_unwired(target: Target) -> Undo:
    """The stimulator's sync line does not reach the cell."""
    return _repacked(target, lambda sample: sample._replace(sync=False))


@fault
def cell_reports_fault(target: Target) -> Undo:
    """The cell says in its status that it is faulty (cells that send one reading and a status)."""
    cell = target.load_cell.cell
    if not cell.has_sync or cell.samples_per_frame > 1:
        raise FaultError(f"the cell '{cell.name}' has no status in its frames")

    def faulty(frame: Frame) -> Iterable[Frame]:
        data = bytearray(frame.data)
        data[STATUS_BYTE] |= FAULT_BIT
        return (frame._replace(data=bytes(data)),)

    return hooked(faulty, target.load_cell.frame_hooks)


STATUS_BYTE, FAULT_BIT = 6, 0x80


def _repacked(target: Target, change: Callable[[Sample], Sample]) -> Undo:
    """The cell's frames are made of changed samples."""
    cell = target.load_cell.cell
    pack = cell.encode
    return replaced(cell, "encode", lambda samples: pack([change(sample) for sample in samples]))


def _error_instead(frame: Frame) -> Frame:
    return frame._replace(can_id=BUS_ERROR_CLASS, data=bytes(8), error=True)


def _hooked_on_bus(target: Target, change: Callable[[Frame], Iterable[Frame]]) -> Undo:
    """Act on all frames of the bus: the cell's and those of an angle sensor."""
    sensors = [target.load_cell, *([target.angle_sensor] if target.angle_sensor else [])]
    return hooked(change, *(sensor.frame_hooks for sensor in sensors))


def _frame_fault(target: Target, probability: float, change: Callable[[Frame], Iterable[Frame]]) -> Undo:
    return hooked(frames_sometimes(target, probability, change), target.load_cell.frame_hooks)

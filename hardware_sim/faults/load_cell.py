"""What breaks on the load cell's side."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import TYPE_CHECKING

from hardware_sim.errors import FaultError
from hardware_sim.faults.registry import Undo, fault, hooked
from hardware_sim.load_cells.frames import Frame

if TYPE_CHECKING:
    from hardware_sim.emulator import Emulator

BUS_OFF_CLASS, BUS_ERROR_CLASS = 0x20000040, 0x20000080
"""Error frames' ids as Linux reports them: flag of error frames and class."""


@fault
def cell_silent(emulator: Emulator) -> Undo:
    """No frame comes any more; the connection stays."""
    return hooked(emulator.load_cell.frame_hooks, lambda _frame: ())


@fault
def cell_unplugged(emulator: Emulator) -> Undo:
    """The adapter is pulled; undone, it is back under another port, and clients must connect anew."""
    emulator.unplug_cell()
    return emulator.plug_cell


@fault
def frames_dropped(emulator: Emulator, probability: float = 0.1) -> Undo:
    """Frames are lost at random."""
    return hooked(
        emulator.load_cell.frame_hooks,
        lambda frame: () if emulator.random.random() < probability else (frame,),
    )


@fault
def frames_duplicated(emulator: Emulator, probability: float = 0.1) -> Undo:
    """Frames come twice at random."""
    return hooked(
        emulator.load_cell.frame_hooks,
        lambda frame: (frame, frame) if emulator.random.random() < probability else (frame,),
    )


@fault
def frames_out_of_order(emulator: Emulator, probability: float = 0.1) -> Undo:
    """At random a frame comes after the one that follows it."""
    kept: list[Frame] = []

    def swap(frame: Frame) -> Iterable[Frame]:
        if kept:
            return (frame, kept.pop())
        if emulator.random.random() < probability:
            kept.append(frame)
            return ()
        return (frame,)

    return hooked(emulator.load_cell.frame_hooks, swap)


@fault
def frames_corrupt(emulator: Emulator, probability: float = 0.1) -> Undo:
    """One bit of a frame's data is another, at random: an adapter's fault, since CAN's CRC would catch it."""

    def flip(frame: Frame) -> Iterable[Frame]:
        if frame.error or not frame.data or emulator.random.random() >= probability:
            return (frame,)
        data = bytearray(frame.data)
        data[emulator.random.randrange(len(data))] ^= 1 << emulator.random.randrange(8)
        return (frame._replace(data=bytes(data)),)

    return hooked(emulator.load_cell.frame_hooks, flip)


@fault
def torque_stuck(emulator: Emulator) -> Undo:
    """The value stays at what it was, noise and all; the counter goes on."""
    first: list[float] = []

    def hold(torque_nm: float) -> float:
        if not first:
            first.append(torque_nm)
        return first[0]

    return hooked(emulator.load_cell.torque_hooks, hold)


@fault
def torque_nan(emulator: Emulator, probability: float = 1.0) -> Undo:
    """The value is not a number."""
    return hooked(
        emulator.load_cell.torque_hooks,
        lambda torque_nm: math.nan if emulator.random.random() < probability else torque_nm,
    )


@fault
def torque_sign_flipped(emulator: Emulator) -> Undo:
    """The cell is mounted the other way round."""
    return hooked(emulator.load_cell.torque_hooks, lambda torque_nm: -torque_nm)


@fault
def torque_saturated(emulator: Emulator, limit_nm: float = 3.0) -> Undo:
    """The amplifier stops at ± `limit_nm`."""
    return hooked(emulator.load_cell.torque_hooks, lambda torque_nm: min(max(torque_nm, -limit_nm), limit_nm))


@fault
def torque_step(emulator: Emulator, step_nm: float = 40.0) -> Undo:
    """The value jumps: a knock on the fixture, or a spasm above the limit."""
    return hooked(emulator.load_cell.torque_hooks, lambda torque_nm: torque_nm + step_nm)


@fault
def bus_off(emulator: Emulator) -> Undo:
    """The adapter reports bus-off once, then nothing comes."""
    time_us = emulator.load_cell.time_us(emulator.timeline.now_s)
    emulator.load_cell.add_frame(Frame(BUS_OFF_CLASS, bytes(8), time_us, error=True))
    return hooked(emulator.load_cell.frame_hooks, lambda _frame: ())


@fault
def error_frames(emulator: Emulator, probability: float = 0.1) -> Undo:
    """Error frames between the others; nothing is lost."""

    def add(frame: Frame) -> Iterable[Frame]:
        if emulator.random.random() < probability:
            return (frame, Frame(BUS_ERROR_CLASS, bytes(8), frame.time_us, error=True))
        return (frame,)

    return hooked(emulator.load_cell.frame_hooks, add)


@fault
def counter_jump(emulator: Emulator, step: int = 1000) -> Undo:
    """The counter jumps once; no sample is lost."""
    emulator.load_cell.counter += int(step)
    return lambda: None


@fault
def rate_off(emulator: Emulator, percent: float = 5.0) -> Undo:
    """The cell samples faster (or slower, below zero) than it says."""
    emulator.load_cell.set_rate_factor(1.0 + percent / 100.0)
    return lambda: emulator.load_cell.set_rate_factor(1.0)


@fault
def clock_jitter(emulator: Emulator, sd_us: float = 100.0) -> Undo:
    """Each sample is taken off its time at random, never by more than 0.45 of a period."""
    if not 0 <= sd_us < math.inf:
        raise FaultError(f"setting 'sd_us' of fault 'clock_jitter' must be a number from 0 on, not {sd_us:g}")
    emulator.load_cell.set_jitter(sd_us * 1e-6)
    return lambda: emulator.load_cell.set_jitter(emulator.settings.clock_jitter_us * 1e-6)


@fault
def delivery_jitter(emulator: Emulator, largest_s: float = 0.02) -> Undo:
    """Frames come late by up to `largest_s` at random, in order and with their own stamps: a busy adapter."""
    if not 0 <= largest_s < math.inf:
        raise FaultError(f"setting 'largest_s' of fault 'delivery_jitter' must be from 0 on, not {largest_s:g}")
    kept: deque[Frame] = deque()
    last_s = 0.0

    def release() -> None:
        if kept:
            emulator.load_cell.add_frame(kept.popleft())

    def keep_back(frame: Frame) -> Iterable[Frame]:
        nonlocal last_s
        last_s = max(last_s, emulator.timeline.now_s + emulator.random.uniform(0.0, largest_s))
        kept.append(frame)
        emulator.timeline.at(last_s, release)
        return ()

    unhook = hooked(emulator.load_cell.frame_hooks, keep_back)

    def undo() -> None:
        unhook()
        while kept:  # else they would come after younger ones
            release()

    return undo

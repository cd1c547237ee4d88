"""Faults of load cell and angle sensor, of their adapter and of the CAN bus.

Those of an angle's readings act also where the angle comes in the cell's frame; those of its frames need frames of its
own. A hook of readings takes a reading and its time; one of frames takes a frame and returns those sent instead.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from operator import attrgetter
from typing import Any

from stimrig.hardware_sim.angle_sensor import AngleSensor, Encoder
from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.faults import Target, Undo, check_not_negative, fault, hook, hooked, replaced
from stimrig.hardware_sim.load_cells.frames import Frame, Sample
from stimrig.hardware_sim.load_cells.sampler import LoadCell

BUS_OFF_CLASS, BUS_ERROR_CLASS = 0x20000040, 0x20000080
"""Ids of error frames as Linux reports them: the flag of error frames and the class."""
STATUS_BYTE, FAULT_BIT = 6, 0x80

FrameHook = Callable[[Frame], Iterable[Frame]]


torque, frames = attrgetter("load_cell.torque_hooks"), attrgetter("load_cell.frame_hooks")
"""Hooks of the cell's readings and of its frames."""


def angle(target: Target) -> list[Any]:
    """Hooks of the encoder's readings."""
    return _encoder(target).hooks


def angle_frames(target: Target) -> list[Any]:
    """Hooks of the angle sensor's frames."""
    return _angle_sensor(target).frame_hooks


def _encoder(target: Target) -> Encoder:
    if target.encoder is None:
        raise HardwareSimError("this rig has no angle sensor; start it with --arm")
    return target.encoder


def _angle_sensor(target: Target) -> AngleSensor:
    _encoder(target)
    if target.angle_sensor is None:
        raise HardwareSimError("the angle is in the cell's frame: use the load cell's fault")
    return target.angle_sensor


@hook(torque_stuck=torque, angle_stuck=angle)
def stuck(target: Target) -> Any:  # noqa: ARG001
    """The reading stays at its present value, without noise; the counter goes on."""
    first: list[float] = []

    def repeat_first(reading: float, _time_s: float) -> float:
        if not first:
            first.append(reading)
        return first[0]

    return repeat_first


@hook(torque_nan=torque, angle_nan=angle)
def not_a_number(target: Target, probability: float = 1.0) -> Any:
    """The reading is not a number; an angle in the cell's frame is its lowest count."""
    return lambda reading, _time_s: math.nan if target.random.random() < probability else reading


@hook(torque)
def torque_sign_flipped(target: Target) -> Any:  # noqa: ARG001
    """The cell is mounted the other way round."""
    return lambda torque_nm, _time_s: -torque_nm


@hook(torque)
def torque_saturated(target: Target, limit_nm: float = 3.0) -> Any:  # noqa: ARG001
    """The amplifier saturates at ± `limit_nm`."""
    return lambda torque_nm, _time_s: min(max(torque_nm, -limit_nm), limit_nm)


@hook(torque)
def torque_step(target: Target, step_nm: float = 40.0) -> Any:  # noqa: ARG001
    """The reading jumps: a knock on the fixture, or a spasm above the limit."""
    return lambda torque_nm, _time_s: torque_nm + step_nm


@hook(torque)
def torque_noisy(target: Target, sd_nm: float = 1.0) -> Any:
    """More noise comes to the reading: a loose shield, mains hum."""
    check_not_negative("sd_nm", sd_nm)
    return lambda torque_nm, _time_s: torque_nm + target.random.gauss(0.0, sd_nm)


@fault
def hung_weight(target: Target, torque_nm: float = 5.0) -> Undo:
    """A weight hangs on the lever. It acts on the cell before every other fault of the reading does."""
    hooks = torque(target)
    hang = lambda reading_nm, _time_s: reading_nm + torque_nm  # noqa: E731
    hooks.insert(0, hang)
    return lambda: hooks.remove(hang)


@hook(angle)
def angle_jump(target: Target, step_deg: float = 20.0, probability: float = 0.02) -> Any:
    """Single readings are off by `step_deg`, at random up or down."""

    def jump(raw_deg: float, _time_s: float) -> float:
        jumps = target.random.random() < probability
        return raw_deg + target.random.choice((-step_deg, step_deg)) if jumps else raw_deg

    return jump


@hook(angle)
def angle_offset_step(target: Target, step_deg: float = 10.0) -> Any:  # noqa: ARG001
    """The reading is off by `step_deg` from now on: the sensor has slipped on the joint."""
    return lambda raw_deg, _time_s: raw_deg + step_deg


@hook(angle)
def angle_reversed(target: Target, about_present: bool = True) -> Any:
    """The reading goes the other way, from where it is (without a jump), or about its own zero."""
    pivot_deg = [] if about_present else [_encoder(target).settings.angle_offset_deg]

    def turn(raw_deg: float, _time_s: float) -> float:
        if not pivot_deg:
            pivot_deg.append(raw_deg)
        return 2.0 * pivot_deg[0] - raw_deg

    return turn


@hook(angle)
def angle_noise_burst(target: Target, sd_deg: float = 2.0) -> Any:
    """Interference: strong white noise on the reading."""
    return lambda raw_deg, _time_s: raw_deg + target.random.gauss(0.0, sd_deg)


@hook(angle)
def angle_delayed(target: Target, delay_s: float = 0.1) -> Any:  # noqa: ARG001
    """The reading is `delay_s` old, by a filter in the sensor; counter and stamp do not know."""
    check_not_negative("delay_s", delay_s)
    waiting: deque[tuple[float, float]] = deque()

    def delay(raw_deg: float, time_s: float) -> float:
        waiting.append((time_s, raw_deg))
        while len(waiting) > 1 and waiting[1][0] <= time_s - delay_s:
            waiting.popleft()
        return waiting[0][1]

    return delay


@fault
def angle_fault_bit(target: Target) -> Undo:
    """The sensor says itself that it is faulty; its readings go on."""
    return replaced(_encoder(target), "fault", True)


@hook(cell_silent=frames, angle_silent=angle_frames)
def silent(target: Target) -> FrameHook:  # noqa: ARG001
    """No frame comes any more; the sensor counts on, and the connection stays."""
    return lambda _frame: ()


@fault
def cell_unplugged(target: Target) -> Undo:
    """The adapter is pulled. When undone, it is back under another port, and clients must connect again."""
    target.plug_cell(False)
    return target.plug_cell


@fault
def angle_unplugged(target: Target) -> Undo:
    """The sensor's cable is pulled. When undone, it starts anew and counts from 0."""
    unhook = hooked(silent(target), angle_frames(target))

    def plug() -> None:
        unhook()
        _angle_sensor(target).counter = 0

    return plug


@hook(frames_dropped=frames, angle_frames_lost=angle_frames)
def lost(target: Target, probability: float = 0.1) -> FrameHook:
    """Frames are lost at random."""
    return _sometimes(target, probability, lambda _frame: ())


@hook(frames_duplicated=frames, angle_frames_repeated=angle_frames)
def repeated(target: Target, probability: float = 0.1) -> FrameHook:
    """Frames come twice at random."""
    return _sometimes(target, probability, lambda frame: (frame, frame))


@hook(frames)
def frames_out_of_order(target: Target, probability: float = 0.1) -> FrameHook:
    """At random a frame comes after the one that follows it."""
    delayed: list[Frame] = []

    def swap(frame: Frame) -> Iterable[Frame]:
        if delayed:
            return (frame, delayed.pop())
        if target.random.random() < probability:
            delayed.append(frame)
            return ()
        return (frame,)

    return swap


@hook(frames)
def frames_corrupt(target: Target, probability: float = 0.1) -> FrameHook:
    """One bit of a frame's data flips at random: a fault of the adapter, since CAN's CRC would catch it."""

    def flip(frame: Frame) -> Iterable[Frame]:
        if frame.error or not frame.data or target.random.random() >= probability:
            return (frame,)
        data = bytearray(frame.data)
        data[target.random.randrange(len(data))] ^= 1 << target.random.randrange(8)
        return (frame._replace(data=bytes(data)),)

    return flip


@hook(frames)
def error_frames(target: Target, probability: float = 0.1) -> FrameHook:
    """Error frames come between the others; nothing is lost."""
    return _sometimes(target, probability, lambda frame: (frame, _error_instead(frame)))


@hook(frames)
def termination_missing(target: Target, probability: float = 0.2) -> FrameHook:
    """A resistor at the bus's end is missing: frames are lost at random, and errors of the bus come instead."""
    return _sometimes(target, probability, lambda frame: (_error_instead(frame),))


@fault
def wrong_bit_rate(target: Target) -> Undo:
    """The adapter listens at another bit rate: instead of frames it reports errors of the bus."""
    return _hooked_on_bus(target, lambda frame: (_error_instead(frame),))


@fault
def bus_off(target: Target) -> Undo:
    """The adapter reports bus-off once, then nothing comes."""
    now_s = target.timeline.now_s
    target.load_cell.add_frame(Frame(BUS_OFF_CLASS, bytes(8), target.load_cell.clock.time_us(now_s), True, now_s))
    return _hooked_on_bus(target, lambda _frame: ())


@fault
def delivery_jitter(target: Target, largest_s: float = 0.02) -> Undo:
    """A busy adapter: frames come up to `largest_s` late at random, in order and with their own time stamps."""
    check_not_negative("largest_s", largest_s)
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
def counter_jump(target: Target, step: int = 1000) -> Undo:
    """The counter jumps once; no sample is lost."""
    return _jump(target.load_cell, step)


@fault
def angle_counter_jump(target: Target, step: int = 1000) -> Undo:
    """The angle's counter jumps once; no sample is lost."""
    return _jump(_angle_sensor(target), step)


@fault
def counter_stuck(target: Target) -> Undo:
    """The counter stands still; the readings go on."""
    stands_at = target.load_cell.counter
    return _repacked(target, lambda sample: sample._replace(counter=stands_at))


@fault
def sync_unwired(target: Target) -> Undo:
    """The stimulator's sync line does not reach the cell."""
    return _repacked(target, lambda sample: sample._replace(sync=False))


@hook(frames)
def cell_reports_fault(target: Target) -> FrameHook:
    """The cell says in its status that it is faulty (cells that send one reading and a status)."""
    cell = target.load_cell.cell
    if not cell.has_sync or cell.samples_per_frame > 1:
        raise HardwareSimError(f"the cell '{cell.name}' has no status in its frames")

    def faulty(frame: Frame) -> Iterable[Frame]:
        data = bytearray(frame.data)
        data[STATUS_BYTE] |= FAULT_BIT
        return (frame._replace(data=bytes(data)),)

    return faulty


@fault
def rate_off(target: Target, percent: float = 5.0) -> Undo:
    """The cell samples faster than nominal, or slower if `percent` is negative."""
    return _at_another_rate(target.load_cell, percent)


@fault
def angle_rate_off(target: Target, percent: float = 5.0) -> Undo:
    """The angle sensor samples faster than nominal, or slower if `percent` is negative."""
    return _at_another_rate(_angle_sensor(target), percent)


@fault
def clock_jitter(target: Target, sd_us: float = 100.0) -> Undo:
    """Each sample is taken off its time at random, never by more than 0.45 of a period."""
    check_not_negative("sd_us", sd_us)
    before_s = target.load_cell.clock.jitter_s
    target.load_cell.clock.set_jitter(sd_us * 1e-6)
    return lambda: target.load_cell.clock.set_jitter(before_s)


def _jump(sensor: LoadCell | AngleSensor, step: int) -> Undo:
    sensor.counter += int(step)
    return lambda: None


def _at_another_rate(sensor: LoadCell | AngleSensor, percent: float) -> Undo:
    if not -100.0 < percent < math.inf:
        raise HardwareSimError(f"setting 'percent' must be above -100, not {percent:g}")
    sensor.clock.set_rate_factor(1.0 + percent / 100.0)
    return lambda: sensor.clock.set_rate_factor(1.0)


def _sometimes(target: Target, probability: float, change: FrameHook) -> FrameHook:
    """Change a frame with this probability."""
    return lambda frame: change(frame) if target.random.random() < probability else (frame,)


def _repacked(target: Target, change: Callable[[Sample], Sample]) -> Undo:
    """The cell's frames are made of changed samples."""
    cell = target.load_cell.cell
    pack = cell.encode
    return replaced(cell, "encode", lambda samples: pack([change(sample) for sample in samples]))


def _error_instead(frame: Frame) -> Frame:
    return frame._replace(can_id=BUS_ERROR_CLASS, data=bytes(8), error=True)


def _hooked_on_bus(target: Target, change: FrameHook) -> Undo:
    """Act on all frames of the bus: the cell's and those of an angle sensor."""
    sensors = [target.load_cell, *([target.angle_sensor] if target.angle_sensor else [])]
    return hooked(change, *(sensor.frame_hooks for sensor in sensors))

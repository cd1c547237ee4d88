"""Faults of the sensor of the joint's angle.

Those of its readings act also where the angle comes in the cell's frame; those of its frames need frames of its own.
"""

from __future__ import annotations

import math
from collections import deque

from stimrig.hardware_sim.angle_sensor import AngleHook, AngleSensor, Encoder
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


@fault
def angle_stuck(target: Target) -> Undo:
    """The reading stays at its present value, without noise; the counter goes on."""
    return _reading(target, stuck())


@fault
def angle_silent(target: Target) -> Undo:
    """No angle frame comes any more; the sensor counts on, and the cell's frames come."""
    return hooked(lambda _frame: (), _sensor(target).frame_hooks)


@fault
def angle_unplugged(target: Target) -> Undo:
    """The sensor's cable is pulled. When undone, it starts anew and counts from 0."""
    unhook = angle_silent(target)

    def plug() -> None:
        unhook()
        _sensor(target).counter = 0

    return plug


@fault
def angle_jump(target: Target, step_deg: float = 20.0, probability: float = 0.02) -> Undo:
    """Single readings are off by `step_deg`, at random up or down."""
    off = lambda raw_deg: raw_deg + target.random.choice((-step_deg, step_deg))  # noqa: E731
    return _reading(target, sometimes(target, probability, off))


@fault
def angle_nan(target: Target, probability: float = 1.0) -> Undo:
    """The reading is not a number (in the cell's frame: its lowest count)."""
    return _reading(target, sometimes(target, probability, lambda _raw_deg: math.nan))


@fault
def angle_offset_step(target: Target, step_deg: float = 10.0) -> Undo:
    """The reading is off by `step_deg` from now on: the sensor has slipped on the joint."""
    return _reading(target, lambda raw_deg, _time_s: raw_deg + step_deg)


@fault
def angle_reversed(target: Target, about_present: bool = True) -> Undo:
    """The reading goes the other way, from where it is (without a jump), or about its own zero."""
    pivot_deg = [] if about_present else [_encoder(target).settings.angle_offset_deg]

    def turn(raw_deg: float, _time_s: float) -> float:
        if not pivot_deg:
            pivot_deg.append(raw_deg)
        return 2.0 * pivot_deg[0] - raw_deg

    return _reading(target, turn)


@fault
def angle_noise_burst(target: Target, sd_deg: float = 2.0) -> Undo:
    """Interference: strong white noise on the reading."""
    return _reading(target, lambda raw_deg, _time_s: raw_deg + target.random.gauss(0.0, sd_deg))


@fault
def angle_delayed(target: Target, delay_s: float = 0.1) -> Undo:
    """The reading is `delay_s` old, by a filter in the sensor; counter and stamp do not know."""
    check_not_negative("angle_delayed", "delay_s", delay_s)
    waiting: deque[tuple[float, float]] = deque()

    def delay(raw_deg: float, time_s: float) -> float:
        waiting.append((time_s, raw_deg))
        while len(waiting) > 1 and waiting[1][0] <= time_s - delay_s:
            waiting.popleft()
        return waiting[0][1]

    return _reading(target, delay)


@fault
def angle_fault_bit(target: Target) -> Undo:
    """The sensor says itself that it is faulty; its readings go on."""
    return replaced(_encoder(target), "fault", True)


@fault
def angle_frames_lost(target: Target, probability: float = 0.1) -> Undo:
    """Angle frames are lost at random."""
    return hooked(frames_sometimes(target, probability, lambda _frame: ()), _sensor(target).frame_hooks)


@fault
def angle_frames_repeated(target: Target, probability: float = 0.1) -> Undo:
    """Angle frames come twice at random."""
    return hooked(frames_sometimes(target, probability, lambda frame: (frame, frame)), _sensor(target).frame_hooks)


@fault
def angle_counter_jump(target: Target, step: int = 1000) -> Undo:
    """The angle's counter jumps once; no sample is lost."""
    _sensor(target).counter += int(step)
    return lambda: None


@fault
def angle_rate_off(target: Target, percent: float = 5.0) -> Undo:
    """The sensor samples faster than nominal, or slower if `percent` is negative."""
    clock = _sensor(target).clock
    if not -100.0 < percent < math.inf:
        raise FaultError(f"setting 'percent' of fault 'angle_rate_off' must be above -100, not {percent:g}")
    return at_another_rate(clock, percent)


def _reading(target: Target, hook: AngleHook) -> Undo:
    return hooked(hook, _encoder(target).hooks)


def _encoder(target: Target) -> Encoder:
    if target.encoder is None:
        raise FaultError("this rig has no angle sensor; start it with --arm")
    return target.encoder


def _sensor(target: Target) -> AngleSensor:
    _encoder(target)
    if target.angle_sensor is None:
        raise FaultError("the angle is in the cell's frame: use the load cell's fault")
    return target.angle_sensor

"""Movers hold or move the forearm: functions of where they take over and of settings, which give the motion at a time.

The motion is asked for at times that never run backwards. Settings come from the command line or the control line.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from stimrig.hardware_sim.arm.motion import (
    Begin,
    Leg,
    Motion,
    Quintic,
    Servo,
    lasting_s,
    path,
    radians,
    radians_per_s,
    within,
)
from stimrig.hardware_sim.errors import HardwareSimError

HAND_HZ, ROBOT_HZ = 3.0, 2.5
ROBOT_LIMIT_RAD_S = math.radians(180.0)
WANDER_RAD, TREMOR_RAD = math.radians(0.6), math.radians(0.003)
PIECES = 5
"""A hand's sweep is made of so many pieces, each at its own speed."""

MotionAt = Callable[[float], Motion]


def held(begin: Begin, angle_deg: float | None = None, deg_s: float = 60.0) -> MotionAt:
    """A fixture holds it still at `angle_deg` (where it is, if none is given).

    It is brought there smoothly with a peak speed of `deg_s`, as nobody jerks an arm.
    """
    start = begin.motion
    target_rad = start.angle_rad if angle_deg is None else radians("angle_deg", angle_deg)
    peak_rad_s = radians_per_s("deg_s", deg_s)
    if angle_deg is None and start.velocity_rad_s:  # it cannot stop on the spot
        target_rad += math.copysign(0.02, start.velocity_rad_s)
    lasts_s = lasting_s(start.angle_rad, target_rad, peak_rad_s)
    return Quintic(begin.time_s, lasts_s, start, Motion(target_rad)).at


def robot(
    begin: Begin,
    from_deg: float = 30.0,
    to_deg: float = 120.0,
    deg_s: float = 30.0,
    pause_s: float = 0.5,
) -> MotionAt:
    """A robot sweeps the forearm between `from_deg` and `to_deg` at `deg_s`, with a rest of `pause_s` at both.

    Its own second-order dynamics lie behind the reference, and a velocity limit. It goes to `from_deg` first.
    """
    ends_rad = radians("from_deg", from_deg), radians("to_deg", to_deg)
    rad_s, rest_s = radians_per_s("deg_s", deg_s), within("pause_s", pause_s, 0.0, 3600.0)

    def legs() -> Iterator[Leg]:
        while True:
            for end_rad in ends_rad:
                yield Leg(end_rad, rad_s, rest_s)

    return Servo(begin, path(begin.time_s, begin.motion.angle_rad, legs()), ROBOT_HZ, ROBOT_LIMIT_RAD_S).at


def hand(
    begin: Begin,
    from_deg: float | None = None,
    to_deg: float | None = None,
    deg_s: float = 30.0,
    pause_s: float = 0.6,
) -> MotionAt:
    """A therapist's hand sweeps between `from_deg` and `to_deg` at about `deg_s`; with one of them, or none, it holds.

    It is not quite steady: each sweep has a speed, a turning point and a pause of its own; the speed within it goes up
    and down. It wanders by slow waves (0.1 to 0.6 Hz) and trembles at 8 to 12 Hz (physiological tremor), so little
    that the cell feels some mN·m of the forearm's inertia.
    """
    rng = np.random.default_rng([begin.seed, 0xA4D])
    first_rad = begin.motion.angle_rad if from_deg is None else radians("from_deg", from_deg)
    last_rad = first_rad if to_deg is None else radians("to_deg", to_deg)
    rad_s = radians_per_s("deg_s", deg_s)
    pause_s = within("pause_s", pause_s, 0.0, 3600.0)
    legs = _uneven_legs(rng, begin.motion.angle_rad, (first_rad, last_rad), rad_s, pause_s)
    sweep = path(begin.time_s, begin.motion.angle_rad, legs)
    # slow waves whose sum has this standard deviation
    waves = [_wave(rng, 0.1, 0.6, lambda _hz: WANDER_RAD * math.sqrt(2.0 / 4)) for _ in range(4)]
    # two close lines that beat; larger by what the arm's own inertia takes off them
    waves += [_wave(rng, 8.0, 12.0, lambda hz: TREMOR_RAD * (hz / HAND_HZ) ** 2) for _ in range(2)]

    def reference_rad(time_s: float) -> float:
        since_s = time_s - begin.time_s
        return sweep(time_s) + sum(a * math.sin(w * since_s + phase) for a, w, phase in waves)

    return Servo(begin, reference_rad, HAND_HZ).at


def _uneven_legs(
    rng: np.random.Generator, at_rad: float, ends_rad: tuple[float, float], rad_s: float, pause_s: float
) -> Iterator[Leg]:
    def factor(sd: float) -> float:
        return math.exp(sd * float(rng.standard_normal()))

    while True:
        for end_rad in ends_rad:
            miss_rad = math.radians(2.0) * float(rng.standard_normal())
            goal_rad = end_rad + (miss_rad if ends_rad[0] != ends_rad[1] else 0.0)
            speed = rad_s * factor(0.15)
            way_rad = (goal_rad - at_rad) / PIECES
            for piece in range(1, PIECES + 1):
                leg_speed = speed * factor(0.12)
                yield Leg(at_rad + piece * way_rad, leg_speed, pause_s * factor(0.5) if piece == PIECES else 0.0)
            at_rad = goal_rad


def _wave(
    rng: np.random.Generator, low_hz: float, high_hz: float, amplitude_rad: Callable[[float], float]
) -> tuple[float, float, float]:
    """Amplitude, rad, angular frequency, rad/s, and phase of a drawn wave."""
    hz = float(rng.uniform(low_hz, high_hz))
    return amplitude_rad(hz), 2.0 * math.pi * hz, float(rng.uniform(0.0, 2.0 * math.pi))


def waves(begin: Begin, hz: Any = (0.1,), deg: Any = (20.0,), phase_rad: Any = (0.0,), deg_s: float = 60.0) -> MotionAt:
    """Slow waves added up, as offline records of hidden patients move: 90° + Σ deg_i sin(2π hz_i t + phase_i).

    Lists of equal length: frequencies, amplitudes, and phases in rad at the time when it takes over. It is first
    brought into the movement with a peak speed of about `deg_s`.
    """
    lists = (hz, deg, phase_rad)
    if not all(isinstance(each, Sequence) and not isinstance(each, str) for each in lists):
        raise HardwareSimError("the arm's waves need 'hz', 'deg' and 'phase_rad': lists of numbers")
    if len({len(each) for each in lists}) != 1:
        raise HardwareSimError("the arm's 'hz', 'deg' and 'phase_rad' must be equally long")
    parts = [
        (
            radians("deg", size, 0.0, 90.0),
            2.0 * math.pi * within("hz", each, 0.0, 5.0),
            within("phase_rad", phase, -1e6, 1e6),
        )
        for each, size, phase in zip(hz, deg, phase_rad, strict=True)
    ]
    peak_rad_s = radians_per_s("deg_s", deg_s)

    def wave(time_s: float) -> Motion:
        since_s = time_s - begin.time_s
        angle_rad, velocity_rad_s, acceleration_rad_s2 = 0.5 * math.pi, 0.0, 0.0
        for size_rad, omega, phase in parts:
            turn = omega * since_s + phase
            angle_rad += size_rad * math.sin(turn)
            velocity_rad_s += size_rad * omega * math.cos(turn)
            acceleration_rad_s2 -= size_rad * omega * omega * math.sin(turn)
        return Motion(angle_rad, velocity_rad_s, acceleration_rad_s2)

    lasts_s = lasting_s(begin.motion.angle_rad, wave(begin.time_s).angle_rad, peak_rad_s)
    lead = Quintic(begin.time_s, lasts_s, begin.motion, wave(begin.time_s + lasts_s))
    return lambda time_s: lead.at(time_s) if time_s < lead.end_s else wave(time_s)


MOVERS: dict[str, Callable[..., MotionAt]] = {"hand": hand, "held": held, "robot": robot, "waves": waves}
"""By name, in alphabetical order."""


def make_mover(mode: str, begin: Begin, settings: Mapping[str, Any]) -> MotionAt:
    """The motion at a time by the named mover.

    Raises HardwareSimError: there is no such mover, or it has no such setting, or a value makes no sense.
    """
    if mode not in MOVERS:
        raise HardwareSimError(f"unknown mode of the arm {mode!r}; there are {', '.join(MOVERS)}")
    known = list(inspect.signature(MOVERS[mode]).parameters)[1:]
    for key in settings:
        if key not in known:
            raise HardwareSimError(f"mode '{mode}' of the arm has no setting '{key}'; it has {', '.join(known)}")
    return MOVERS[mode](begin, **settings)

"""Motion of the elbow, and the curves and the servo that movers are made of.

Angle 0 is the straight arm, flexion is positive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

from stimrig.hardware_sim.errors import HardwareSimError

SMALLEST_DEG, LARGEST_DEG = -10.0, 160.0
"""Angles that a mover accepts; people reach -5 to 150 degrees."""
SLOWEST_DEG_S, FASTEST_DEG_S = 0.1, 1000.0


class Motion(NamedTuple):
    """Angle, rad, its velocity, rad/s, and its acceleration, rad/s²."""

    angle_rad: float
    velocity_rad_s: float = 0.0
    acceleration_rad_s2: float = 0.0


class Begin(NamedTuple):
    """Where a mover takes over: the time, the motion then, and the seed of all that is random about it."""

    time_s: float
    motion: Motion
    seed: int = 0


Drive = Callable[[float, float], float]
"""Angular acceleration of a forearm that nobody holds, rad/s², at an angle, rad, and a velocity, rad/s."""


def radians(name: str, degrees: float, low: float = SMALLEST_DEG, high: float = LARGEST_DEG) -> float:
    """A setting in degrees, checked as by `within`, in radians."""
    return math.radians(within(name, degrees, low, high))


def radians_per_s(name: str, degrees_per_s: float) -> float:
    """A setting in degrees/s, checked as by `within`, in rad/s."""
    return radians(name, degrees_per_s, SLOWEST_DEG_S, FASTEST_DEG_S)


def within(name: str, value: float, low: float, high: float) -> float:
    """A setting, checked. Raises HardwareSimError: it is no number or out of its range."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and low <= value <= high):
        raise HardwareSimError(f"the arm's '{name}' must be between {low:g} and {high:g}, not {value!r}")
    return float(value)


PEAK_OVER_MEAN = 15.0 / 8.0
SHORTEST_S = 0.2


class Quintic:
    """A smooth way from `start` at `begin_s` to `end` after `lasts_s`; before and after, the ends.

    A polynomial of the fifth degree, whose rest-to-rest form is minimum jerk: Flash and Hogan 1985, people move their
    arms so. Peak speed is 15/8 of the mean.
    """

    def __init__(self, begin_s: float, lasts_s: float, start: Motion, end: Motion) -> None:
        self.begin_s, self.end_s = begin_s, begin_s + lasts_s
        self.start, self.end = start, end
        t = lasts_s
        x0, v0, a0 = start
        x1, v1, a1 = end
        dx, dv, da = x1 - x0 - t * (v0 + 0.5 * t * a0), v1 - v0 - t * a0, a1 - a0
        self._c = (
            x0,
            v0,
            0.5 * a0,
            (10.0 * dx - 4.0 * dv * t + 0.5 * da * t * t) / t**3,
            (-15.0 * dx + 7.0 * dv * t - da * t * t) / t**4,
            (6.0 * dx - 3.0 * dv * t + 0.5 * da * t * t) / t**5,
        )

    def at(self, time_s: float) -> Motion:
        """The motion at a time."""
        if time_s <= self.begin_s:
            return self.start
        if time_s >= self.end_s:
            return self.end
        t = time_s - self.begin_s
        c0, c1, c2, c3, c4, c5 = self._c
        return Motion(
            c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5)))),
            c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5))),
            2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5)),
        )


def lasting_s(from_rad: float, to_rad: float, peak_rad_s: float) -> float:
    """Return the duration of a minimum-jerk movement with this peak speed, s."""
    return max(SHORTEST_S, PEAK_OVER_MEAN * abs(to_rad - from_rad) / peak_rad_s)


GRID_S, DAMPING = 0.001, 0.9


class Leg(NamedTuple):
    """One piece of a reference: to this angle at this speed, then a pause."""

    to_rad: float
    rad_s: float
    pause_s: float


def path(begin_s: float, start_rad: float, legs: Iterator[Leg]) -> Callable[[float], float]:
    """The reference, rad, made of legs, one after another; asked at rising times."""
    from_s, from_rad, leg = begin_s, start_rad, next(legs)

    def at(time_s: float) -> float:
        nonlocal from_s, from_rad, leg
        while True:
            moves_s = abs(leg.to_rad - from_rad) / leg.rad_s
            end_s = from_s + max(moves_s + leg.pause_s, GRID_S)
            if time_s < end_s:
                gone = min((time_s - from_s) / moves_s, 1.0) if moves_s > 0.0 else 1.0
                return from_rad + gone * (leg.to_rad - from_rad)
            from_s, from_rad, leg = end_s, leg.to_rad, next(legs)

    return at


class Servo:
    """Follows `reference` from the motion at which it takes over, by second-order dynamics.

    x'' = ω² (r(t) - x) - 2 ζ ω x', the velocity limited, on a grid of 1 ms; between two grid points a cubic through
    angles and velocities, so that angle, velocity and acceleration always belong together.
    """

    def __init__(
        self, begin: Begin, reference: Callable[[float], float], bandwidth_hz: float, limit_rad_s: float = math.inf
    ) -> None:
        self._reference, self._limit_rad_s = reference, limit_rad_s
        omega = 2.0 * math.pi * bandwidth_hz
        self._stiffness, self._damping = omega * omega, 2.0 * DAMPING * omega
        self._begin_s, self._steps = begin.time_s, 0
        self._last = self._now = (begin.motion.angle_rad, begin.motion.velocity_rad_s)

    def at(self, time_s: float) -> Motion:
        """The motion at a time that never runs backwards."""
        since_s = time_s - self._begin_s
        if since_s <= 0.0:
            return Motion(*self._now)
        while self._steps * GRID_S < since_s:
            self._step()
        return _between(self._last, self._now, since_s - (self._steps - 1) * GRID_S)

    def _step(self) -> None:
        self._last = x, v = self._now
        reference_rad = self._reference(self._begin_s + self._steps * GRID_S)
        # the velocity first: with the old one for the angle, this explicit rule would gain energy
        faster = v + GRID_S * (self._stiffness * (reference_rad - x) - self._damping * v)
        faster = min(max(faster, -self._limit_rad_s), self._limit_rad_s)
        self._now = x + 0.5 * GRID_S * (v + faster), faster
        self._steps += 1


def _between(first: tuple[float, float], second: tuple[float, float], since_s: float) -> Motion:
    """On the cubic between two grid points, `since_s` after the first."""
    (x0, v0), (x1, v1), h = first, second, GRID_S
    t, mean = min(since_s, h), (x1 - x0) / h
    c2, c3 = (3.0 * mean - 2.0 * v0 - v1) / h, (v0 + v1 - 2.0 * mean) / (h * h)
    return Motion(x0 + t * (v0 + t * (c2 + t * c3)), v0 + t * (2.0 * c2 + 3.0 * t * c3), 2.0 * c2 + 6.0 * t * c3)

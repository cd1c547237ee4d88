"""A second-order servo that follows a reference, and the way there and back that references are made of.

x'' = ω² (r(t) - x) - 2 ζ ω x', the velocity limited, on a grid of 1 ms; between two grid points a cubic through angles
and velocities, so that angle, velocity and acceleration always belong together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

from stimrig.hardware_sim.arm.motion import Begin, Motion

GRID_S = 0.001


class Leg(NamedTuple):
    """One piece of a reference: to this angle at this speed, then a pause."""

    to_rad: float
    rad_s: float
    pause_s: float


class Path:
    """The reference made of legs, one after another, from `start_rad` at `begin_s`; asked at rising times."""

    def __init__(self, begin_s: float, start_rad: float, legs: Iterator[Leg]) -> None:
        self._legs = legs
        self._from_s, self._from_rad = begin_s, start_rad
        self._next()

    def at(self, time_s: float) -> float:
        """The reference, rad."""
        while time_s >= self._end_s:
            self._from_s, self._from_rad = self._end_s, self._leg.to_rad
            self._next()
        gone = min((time_s - self._from_s) / self._moves_s, 1.0) if self._moves_s > 0.0 else 1.0
        return self._from_rad + gone * (self._leg.to_rad - self._from_rad)

    def _next(self) -> None:
        self._leg = leg = next(self._legs)
        self._moves_s = abs(leg.to_rad - self._from_rad) / leg.rad_s
        self._end_s = self._from_s + max(self._moves_s + leg.pause_s, GRID_S)


class Servo:
    """Follows `reference` from the motion at which it takes over."""

    def __init__(
        self,
        begin: Begin,
        reference: Callable[[float], float],
        bandwidth_hz: float,
        damping: float = 0.9,
        limit_rad_s: float = math.inf,
    ) -> None:
        self._reference, self._limit_rad_s = reference, limit_rad_s
        omega = 2.0 * math.pi * bandwidth_hz
        self._stiffness, self._damping = omega * omega, 2.0 * damping * omega
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

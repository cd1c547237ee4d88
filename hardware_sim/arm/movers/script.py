"""A movement written down beforehand: times and angles, with a smooth curve through them.

Between the points a monotone cubic (PCHIP, Fritsch and Carlson 1980), which never overshoots them. The forearm is first
brought to the first point, and comes to rest after the last.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from stimrig.hardware_sim.arm.curve import Quintic, lasting_s
from stimrig.hardware_sim.arm.motion import FASTEST_DEG_S, SLOWEST_DEG_S, Begin, Drive, Motion, radians
from stimrig.hardware_sim.errors import ArmError

STOPS_WITHIN_S = 0.3


class Mover:
    """Through `points`, [[t_s, deg], …]; t counts from when the first is reached, at a peak speed of `deg_s`."""

    holds = True

    def __init__(self, begin: Begin, points: Any = None, deg_s: float = 60.0) -> None:
        times_s, angles_rad = _read(points)
        peak_rad_s = radians("deg_s", deg_s, SLOWEST_DEG_S, FASTEST_DEG_S)
        curve = PchipInterpolator(times_s, angles_rad)
        self._times_s = times_s.tolist()
        self._pieces = curve.c.T.tolist()
        self._origin_s = 0.0
        first = self._on_curve(self._times_s[0])
        there = begin.motion[:2] == first[:2]
        lasts_s = 0.0 if there else lasting_s(begin.motion.angle_rad, first.angle_rad, peak_rad_s)
        self._lead = None if there else Quintic(begin.time_s, lasts_s, begin.motion, first)
        self._origin_s = begin.time_s + lasts_s - self._times_s[0]
        self._last_s = self._origin_s + self._times_s[-1]
        end = self._on_curve(self._last_s)
        rest = Motion(end.angle_rad + 0.5 * STOPS_WITHIN_S * end.velocity_rad_s)
        self._stop = Quintic(self._last_s, STOPS_WITHIN_S, end, rest)

    def advance(self, time_s: float, drive: Drive) -> Motion:  # noqa: ARG002
        """The motion at `time_s`."""
        if self._lead is not None and time_s < self._lead.end_s:
            return self._lead.at(time_s)
        if time_s >= self._last_s:
            return self._stop.at(time_s)
        return self._on_curve(time_s)

    def _on_curve(self, time_s: float) -> Motion:
        at_s = time_s - self._origin_s
        piece = min(max(bisect.bisect_right(self._times_s, at_s) - 1, 0), len(self._pieces) - 1)
        t = at_s - self._times_s[piece]
        c3, c2, c1, c0 = self._pieces[piece]
        return Motion(c0 + t * (c1 + t * (c2 + t * c3)), c1 + t * (2.0 * c2 + t * 3.0 * c3), 2.0 * c2 + 6.0 * t * c3)


def _read(points: Any) -> tuple[np.ndarray, np.ndarray]:
    """Times, s, rising from 0 or later, and angles, rad."""
    if not (isinstance(points, Sequence) and len(points) >= 2 and all(_is_point(point) for point in points)):
        raise ArmError("an arm's script needs 'points': two or more [time in s, angle in degrees]")
    times_s = np.array([float(point[0]) for point in points])
    if not (np.all(np.isfinite(times_s)) and times_s[0] >= 0.0 and np.all(np.diff(times_s) > 0.0)):
        raise ArmError("the times of an arm's script must rise from each point to the next, from 0 s or later")
    return times_s, np.array([radians("points", point[1]) for point in points])


def _is_point(point: Any) -> bool:
    pair = isinstance(point, Sequence) and not isinstance(point, str) and len(point) == 2
    return pair and all(isinstance(value, int | float) and not isinstance(value, bool) for value in point)

"""Smooth ways from one motion to another: polynomials of the fifth degree, whose rest-to-rest form is minimum jerk.

Flash and Hogan 1985: people move their arms with the least jerk. Peak speed is 15/8 of the mean.
"""

from __future__ import annotations

from stimrig.hardware_sim.arm.motion import Motion

PEAK_OVER_MEAN = 15.0 / 8.0
SHORTEST_S = 0.2


class Quintic:
    """From `start` at `begin_s` to `end` after `lasts_s`; before and after, the ends."""

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
    """How long a minimum-jerk movement takes at this peak speed, s."""
    return max(SHORTEST_S, PEAK_OVER_MEAN * abs(to_rad - from_rad) / peak_rad_s)

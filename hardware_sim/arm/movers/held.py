"""A fixture holds the forearm still. It is brought there smoothly, as nobody jerks an arm."""

from __future__ import annotations

import math

from stimrig.hardware_sim.arm.curve import Quintic, lasting_s
from stimrig.hardware_sim.arm.motion import FASTEST_DEG_S, SLOWEST_DEG_S, Begin, Drive, Motion, radians


class Mover:
    """At `angle_deg` (where it is, if none is given), reached with a peak speed of `deg_s`."""

    holds = True

    def __init__(self, begin: Begin, angle_deg: float | None = None, deg_s: float = 60.0) -> None:
        start = begin.motion
        target_rad = start.angle_rad if angle_deg is None else radians("angle_deg", angle_deg)
        peak_rad_s = radians("deg_s", deg_s, SLOWEST_DEG_S, FASTEST_DEG_S)
        if angle_deg is None and start.velocity_rad_s:  # it cannot stop on the spot
            target_rad += math.copysign(0.02, start.velocity_rad_s)
        lasts_s = lasting_s(start.angle_rad, target_rad, peak_rad_s)
        self._way = Quintic(begin.time_s, lasts_s, start, Motion(target_rad))

    def advance(self, time_s: float, drive: Drive) -> Motion:  # noqa: ARG002
        """The motion at `time_s`."""
        return self._way.at(time_s)

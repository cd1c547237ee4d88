"""Slow waves added up, as offline records of hidden patients move: middle + Σ deg_i sin(2π hz_i t + phase_i)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from stimrig.hardware_sim.arm.curve import Quintic, lasting_s
from stimrig.hardware_sim.arm.motion import FASTEST_DEG_S, SLOWEST_DEG_S, Begin, Drive, Motion, radians, within
from stimrig.hardware_sim.errors import ArmError


class Mover:
    """Lists of equal length: frequencies, amplitudes, and phases in rad at the time when it takes over.

    It is first brought into the movement with a peak speed of about `deg_s`.
    """

    holds = True

    def __init__(
        self,
        begin: Begin,
        hz: Any = (0.1,),
        deg: Any = (20.0,),
        phase_rad: Any = (0.0,),
        middle_deg: float = 90.0,
        deg_s: float = 60.0,
    ) -> None:
        lists = (hz, deg, phase_rad)
        if not all(isinstance(each, Sequence) and not isinstance(each, str) for each in lists):
            raise ArmError("the arm's waves need 'hz', 'deg' and 'phase_rad': lists of numbers")
        if len({len(each) for each in lists}) != 1:
            raise ArmError("the arm's 'hz', 'deg' and 'phase_rad' must be equally long")
        self._waves = [
            (radians("deg", size, 0.0, 90.0), 2.0 * math.pi * within("hz", each, 0.0, 5.0), _finite(phase))
            for each, size, phase in zip(hz, deg, phase_rad, strict=True)
        ]
        self._middle_rad, self._begin_s = radians("middle_deg", middle_deg), begin.time_s
        peak_rad_s = radians("deg_s", deg_s, SLOWEST_DEG_S, FASTEST_DEG_S)
        target = self._wave(begin.time_s)
        lasts_s = lasting_s(begin.motion.angle_rad, target.angle_rad, peak_rad_s)
        self._lead = Quintic(begin.time_s, lasts_s, begin.motion, self._wave(begin.time_s + lasts_s))

    def advance(self, time_s: float, drive: Drive) -> Motion:  # noqa: ARG002
        """The motion at `time_s`."""
        return self._lead.at(time_s) if time_s < self._lead.end_s else self._wave(time_s)

    def _wave(self, time_s: float) -> Motion:
        since_s = time_s - self._begin_s
        angle_rad, velocity_rad_s, acceleration_rad_s2 = self._middle_rad, 0.0, 0.0
        for size_rad, omega, phase in self._waves:
            turn = omega * since_s + phase
            angle_rad += size_rad * math.sin(turn)
            velocity_rad_s += size_rad * omega * math.cos(turn)
            acceleration_rad_s2 -= size_rad * omega * omega * math.sin(turn)
        return Motion(angle_rad, velocity_rad_s, acceleration_rad_s2)


def _finite(phase: Any) -> float:
    return within("phase_rad", phase, -1e6, 1e6)

"""Tissue that relaxes: a spring beside a spring and dashpot in series (the standard linear solid of Fung 1981).

    h = -k (s (x - x_0) + (1 - s) (x - z)) - b ẋ,   τ z' = x - z

After a movement the part (1 - s) of the stiffness relaxes with the time constant τ. So h is no function of x and ẋ
alone: `torque_nm` is that of a joint which has been there for long, and `remembered_nm` comes to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from stimrig.hardware_sim.arm.law import Number, PassiveLaw


@dataclass(frozen=True)
class Law(PassiveLaw):
    """The memory is the dashpot's angle z."""

    ABOVE: ClassVar[dict[str, float]] = {"relaxation_s": 0.0}

    stiffness_nm_per_rad: float = 2.0
    lasting_share: float = 0.6
    rest_rad: float = 1.4
    relaxation_s: float = 1.0
    viscosity_nm_s: float = 0.05

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Passive torque of tissue that has relaxed, N·m."""
        lasting_nm = -self.stiffness_nm_per_rad * self.lasting_share * (angle_rad - self.rest_rad)
        return lasting_nm - self.viscosity_nm_s * velocity_rad_s

    def begin(self, angle_rad: float) -> float:
        """A relaxed dashpot."""
        return angle_rad

    def step(self, memory: float, angle_rad: float, step_s: float) -> float:
        """Exact for an angle that stays."""
        return angle_rad + (memory - angle_rad) * math.exp(-step_s / self.relaxation_s)

    def remembered_nm(self, memory: Number, angle_rad: Number) -> Number:
        """Torque that will relax, N·m."""
        return -self.stiffness_nm_per_rad * (1.0 - self.lasting_share) * (angle_rad - memory)

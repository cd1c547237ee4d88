"""Exponentials at both ends of the range, a constant and viscosity.

    h = exp(-k_e (x - x_e)) - exp(k_f (x - x_f)) + c - b ẋ

Riener and Edrich 1999 write the passive elastic moment of hip, knee and ankle as a sum of two exponentials and a
constant, after Hatze 1997, who has elbow and shoulder too. The numbers here are not theirs: they give less than 1 N·m
between 25 and 125 degrees, and some N·m near the ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.hardware_sim.arm.law import Number, PassiveLaw


@dataclass(frozen=True)
class Law(PassiveLaw):
    """`extended_rad`, `flexed_rad`: where each end's exponential is 1 N·m."""

    extended_per_rad: float = 4.0
    extended_rad: float = 0.35
    flexed_per_rad: float = 4.0
    flexed_rad: float = 2.25
    constant_nm: float = 0.0
    viscosity_nm_s: float = 0.1

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Passive torque, N·m."""
        extended_nm = np.exp(-self.extended_per_rad * (angle_rad - self.extended_rad))
        flexed_nm = np.exp(self.flexed_per_rad * (angle_rad - self.flexed_rad))
        return extended_nm - flexed_nm + self.constant_nm - self.viscosity_nm_s * velocity_rad_s

"""Stretched fibres of a flexor and an extensor, and viscosity.

    h = M_f p(1 + r_f (x_f - x)) - M_e p(1 + r_e (x - x_e)) - b ẋ,   p(l) = (exp(4 (l - 1) / 0.6) - 1) / (exp(4) - 1)

p is the passive force-length curve of De Groote, Kinney, Rao and Fregly 2016, 0 below the slack length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.hardware_sim.arm.law import Number, PassiveLaw

STIFFNESS, STRAIN = 4.0, 0.6


def _of_fibre(stretch: Number) -> Number:
    return np.expm1(STIFFNESS * np.maximum(stretch, 0.0) / STRAIN) / np.expm1(STIFFNESS)


@dataclass(frozen=True)
class Law(PassiveLaw):
    """Torque of each muscle at a stretch of 0.6 lengths, lengths per rad, and the angle where it is slack."""

    flexor_nm: float = 6.0
    flexor_lengths_per_rad: float = 0.5
    flexor_slack_rad: float = 1.3
    extensor_nm: float = 5.0
    extensor_lengths_per_rad: float = 0.4
    extensor_slack_rad: float = 1.5
    viscosity_nm_s: float = 0.15

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Passive torque, N·m."""
        flexor = _of_fibre(self.flexor_lengths_per_rad * (self.flexor_slack_rad - angle_rad))
        extensor = _of_fibre(self.extensor_lengths_per_rad * (angle_rad - self.extensor_slack_rad))
        return self.flexor_nm * flexor - self.extensor_nm * extensor - self.viscosity_nm_s * velocity_rad_s

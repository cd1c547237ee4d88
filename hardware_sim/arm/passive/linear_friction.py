"""A spring, a dashpot and dry friction.

    h = -k (x - x_0) - b ẋ - d tanh(ẋ / v_0)

The linear second-order joint of many tests of limb impedance (Agarwal and Gottlieb 1977; Wiegner and Watts 1986 for the
relaxed elbow) with Coulomb's friction, smooth at rest. The numbers are of their order of magnitude, not theirs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from stimrig.hardware_sim.arm.law import Number, PassiveLaw


@dataclass(frozen=True)
class Law(PassiveLaw):
    """A linear joint; within `smooth_rad_s` of rest, friction is smaller than `dry_nm`."""

    ABOVE: ClassVar[dict[str, float]] = {"smooth_rad_s": 0.0}

    stiffness_nm_per_rad: float = 1.5
    rest_rad: float = 1.4
    viscosity_nm_s: float = 0.15
    dry_nm: float = 0.15
    smooth_rad_s: float = 0.05

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Passive torque, N·m."""
        elastic_nm = -self.stiffness_nm_per_rad * (angle_rad - self.rest_rad)
        dry_nm = self.dry_nm * np.tanh(velocity_rad_s / self.smooth_rad_s)
        return elastic_nm - self.viscosity_nm_s * velocity_rad_s - dry_nm

"""A parabola of the angle: 1 + A Δ - B Δ², Δ = 90° - θ, after Marion, Wexler and Hull 2010.

Their A and B are 0.0344 and 4.49e-4 per degree, of the quadriceps. With these an elbow would have no torque beyond 118
degrees, so the default takes a flatter one of the same form, most at 80 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from stimrig.hardware_sim.arm.law import Number


@dataclass(frozen=True)
class Law:
    """Never below `least`."""

    ABOVE: ClassVar[dict[str, float]] = {"least": 0.0}

    linear_per_deg: float = 0.002
    quadratic_per_deg2: float = 1.0e-4
    least: float = 0.05

    def share(self, angle_rad: Number) -> Number:
        """Share of the torque at 90 degrees."""
        off_deg = 90.0 - np.degrees(angle_rad)
        share = 1.0 + self.linear_per_deg * off_deg - self.quadratic_per_deg2 * off_deg * off_deg
        return np.maximum(share, self.least)

"""A moment arm times the force of fibres whose length follows the joint: the product of the two curves.

    (r_0 + (1 - r_0) cos(c (x - x_arm))) · exp(-(r (x_length - x))² / γ)

The shapes of `moment_arm` (Murray, Delp and Buchanan 1995) and `force_length` (Thelen 2003).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from stimrig.hardware_sim.arm.law import Number


@dataclass(frozen=True)
class Law:
    """Angles where the arm and where the force is largest, rad; the other numbers are those of the two laws."""

    ABOVE: ClassVar[dict[str, float]] = {"gamma": 0.0}

    arm_best_rad: float = 1.7
    arm_least: float = 0.45
    sharpness: float = 1.1
    length_best_rad: float = 1.2
    lengths_per_rad: float = 0.45
    gamma: float = 0.45

    def share(self, angle_rad: Number) -> Number:
        """Share of largest arm times largest force."""
        turn = np.clip(self.sharpness * (angle_rad - self.arm_best_rad), -0.5 * math.pi, 0.5 * math.pi)
        stretch = self.lengths_per_rad * (self.length_best_rad - angle_rad)
        return (self.arm_least + (1.0 - self.arm_least) * np.cos(turn)) * np.exp(-stretch * stretch / self.gamma)

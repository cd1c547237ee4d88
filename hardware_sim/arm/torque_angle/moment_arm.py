"""A moment arm that is largest in mid-range and falls towards both ends, as that of biceps brachii.

    r(x) = r_0 + (1 - r_0) cos(c (x - x_best))     as a share of the largest

In the shape of the measurements of Murray, Delp and Buchanan 1995; their elbow flexors have peaks between 90 and 110
degrees or so. c makes both slopes; r_0 is what is left where the cosine is 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stimrig.hardware_sim.arm.law import Number


@dataclass(frozen=True)
class Law:
    """Angle of the largest arm, rad; smallest share; how many rad of the cosine a rad of the joint is."""

    best_rad: float = 1.6
    least: float = 0.4
    sharpness: float = 1.1

    def share(self, angle_rad: Number) -> Number:
        """Share of the largest moment arm; beyond a quarter wave it stays at the least."""
        turn = np.clip(self.sharpness * (angle_rad - self.best_rad), -0.5 * math.pi, 0.5 * math.pi)
        return self.least + (1.0 - self.least) * np.cos(turn)

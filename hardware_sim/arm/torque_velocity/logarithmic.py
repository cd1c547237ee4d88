"""The force-velocity curve of De Groote, Kinney, Rao and Fregly 2016.

    d1 log(d2 v + d3 + sqrt((d2 v + d3)² + 1)) + d4,   d = -0.318, -8.149, -0.374, 0.886,   v positive where stretched

Divided by its value at rest (1.0023).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from stimrig.hardware_sim.arm.law import Number

D1, D2, D3, D4 = -0.318, -8.149, -0.374, 0.886
AT_REST = D1 * math.asinh(D3) + D4


@dataclass(frozen=True)
class Law:
    """Largest velocity of the joint, rad/s."""

    ABOVE: ClassVar[dict[str, float]] = {"largest_rad_s": 0.0}

    largest_rad_s: float = 15.0

    def share(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Share of the torque at rest."""
        stretched = -velocity_rad_s / self.largest_rad_s + 0.0 * angle_rad
        return np.maximum((D1 * np.arcsinh(D2 * stretched + D3) + D4) / AT_REST, 0.0)

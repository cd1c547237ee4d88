"""Hill's hyperbola (1938), and for a stretched muscle one that rises to a plateau (Katz 1939), with one slope at rest.

shortening: (1 - v) / (1 + v / a),   stretched: 1 + (p - 1) s |v| / (p - 1 + s |v|),   s = 1 + 1 / a,   v = ẋ / v_max
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from stimrig.hardware_sim.arm.law import Number


@dataclass(frozen=True)
class Law:
    """Largest velocity of the joint, rad/s; curvature a; plateau p."""

    ABOVE: ClassVar[dict[str, float]] = {"largest_rad_s": 0.0, "curvature": 0.0, "plateau": 1.0}

    largest_rad_s: float = 15.0
    curvature: float = 0.3
    plateau: float = 1.5

    def share(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Share of the torque at rest."""
        v = velocity_rad_s / self.largest_rad_s + 0.0 * angle_rad
        shortening = np.clip(v, 0.0, 1.0)
        stretched = (1.0 + 1.0 / self.curvature) * np.maximum(-v, 0.0)
        gain = self.plateau - 1.0
        return (1.0 - shortening) / (1.0 + shortening / self.curvature) + gain * stretched / (gain + stretched)

"""Velocity times a bell of the angle: 1 - s b(θ) ẋ, b = V2 θ exp(1 - V2 θ), after Marion, Wexler and Hull 2010.

Their force loses V1 θ exp(-V2 θ) θ', θ in degrees, V2 = 0.0229. Here the bell's peak is 1, at 1 / V2 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from stimrig.hardware_sim.arm.law import Number


@dataclass(frozen=True)
class Law:
    """Share lost per rad/s where it is most; V2 per degree; a stretched muscle gains no more than `plateau`."""

    ABOVE: ClassVar[dict[str, float]] = {"plateau": 1.0}

    lost_per_rad_s: float = 0.15
    v2_per_deg: float = 0.0229
    plateau: float = 1.8

    def share(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Share of the torque at rest."""
        turn = self.v2_per_deg * np.maximum(np.degrees(angle_rad), 0.0)
        bell = turn * np.exp(1.0 - turn)
        return np.clip(1.0 - self.lost_per_rad_s * bell * velocity_rad_s, 0.0, self.plateau)

"""A Gaussian of the fibre's length, exp(-(l - 1)² / γ), l = 1 + r (x_best - x); Thelen 2003, γ = 0.45.

A flexor's fibres shorten as the elbow flexes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from stimrig.hardware_sim.arm.law import Number


@dataclass(frozen=True)
class Law:
    """Best angle, rad, lengths per rad, and γ."""

    ABOVE: ClassVar[dict[str, float]] = {"gamma": 0.0}

    best_rad: float = 1.4
    lengths_per_rad: float = 0.5
    gamma: float = 0.45

    def share(self, angle_rad: Number) -> Number:
        """Share of the largest force."""
        stretch = self.lengths_per_rad * (self.best_rad - angle_rad)
        return np.exp(-stretch * stretch / self.gamma)

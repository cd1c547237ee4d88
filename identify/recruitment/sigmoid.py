"""Sigmoid recruitment, equation (30) of the paper: a1 (e^{a2 u} - 1) / (e^{a2 u} + a3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SigmoidBasis:
    """The sigmoid of equation (30) with its two shape parameters fixed: one coefficient, the gain a1 in N·m.

    Parameters
    ----------
    a2_per_us : float
        Steepness, 1/µs, positive.
    a3 : float
        Position: half of the gain is reached where e^{a2 u} = a3 + 2.
    largest_us : float
        Largest pulse width it was fitted on, µs.
    """

    a2_per_us: float
    a3: float
    largest_us: float = 300.0

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return 1

    def design(self, pulse_width_us: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Shape (..., 1); derivatives by the closed form, up to the second."""
        u = np.asarray(pulse_width_us, float)
        decay = np.exp(-self.a2_per_us * np.maximum(u, 0.0))
        bottom = 1.0 + self.a3 * decay
        if derivative == 0:
            value = (1.0 - decay) / bottom
        elif derivative == 1:
            value = self.a2_per_us * (1.0 + self.a3) * decay / bottom**2
        elif derivative == 2:
            value = self.a2_per_us**2 * (1.0 + self.a3) * decay * (self.a3 * decay - 1.0) / bottom**3
        else:
            raise ValueError("derivatives up to the second")
        return value[..., None]

    def to_dict(self) -> dict:
        return {"kind": "sigmoid", "a2_per_us": self.a2_per_us, "a3": self.a3, "largest_us": self.largest_us}

    @classmethod
    def from_dict(cls, data: dict) -> SigmoidBasis:
        return cls(float(data["a2_per_us"]), float(data["a3"]), float(data.get("largest_us", 300.0)))

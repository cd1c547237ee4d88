"""A curve of given shape, with one coefficient, its gain: for steps that estimate only the dynamics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identify.recruitment.curve import Curve


@dataclass(frozen=True)
class FixedShape:
    """A gain times a given curve."""

    curve: Curve

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return 1

    @property
    def largest_us(self) -> float:
        """Pulse width beyond which the curve is held, µs."""
        return self.curve.basis.largest_us

    def design(self, pulse_width_us: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Shape (..., 1)."""
        return (self.curve.basis.design(np.asarray(pulse_width_us, float), derivative) @ self.curve.coefficients_nm)[
            ..., None
        ]

    def to_dict(self) -> dict:
        return self.curve.to_dict()

"""Power series recruitment, equation (6) of the paper: u, u², …"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PowerBasis:
    """Powers 1 … order of u / scale.

    Parameters
    ----------
    order : int
        Highest power.
    scale_us : float
        Pulse width that is scaled to 1, so that all powers have a similar size, µs.
    """

    order: int
    scale_us: float

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.order

    @property
    def largest_us(self) -> float:
        """Pulse width beyond which the curve is held, µs."""
        return self.scale_us

    def design(self, pulse_width_us: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Powers (or a derivative) at pulse widths of any shape; shape (..., order)."""
        u = np.clip(np.asarray(pulse_width_us, float), 0.0, self.scale_us) / self.scale_us
        columns = []
        for p in range(1, self.order + 1):
            lead = float(np.prod(np.arange(p, p - derivative, -1))) if derivative else 1.0
            columns.append(lead * u ** max(p - derivative, 0) / self.scale_us**derivative)
        return np.stack(columns, axis=-1)

    def to_dict(self) -> dict:
        return {"kind": "power-series", "order": self.order, "scale_us": self.scale_us}

    @classmethod
    def from_dict(cls, data: dict) -> PowerBasis:
        return cls(int(data["order"]), float(data["scale_us"]))

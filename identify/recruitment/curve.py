"""A recruitment curve: basis and coefficients, with its table and its inverse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from identify.errors import BadModel


class Basis(Protocol):
    """The basis functions of one kind of recruitment curve; all are zero at zero pulse width."""

    @property
    def size(self) -> int: ...

    @property
    def largest_us(self) -> float: ...

    def design(self, pulse_width_us: np.ndarray, derivative: int = 0) -> np.ndarray: ...

    def to_dict(self) -> dict: ...


@dataclass(frozen=True)
class Curve:
    """f(u) = sum of coefficients times basis functions, N·m.

    Parameters
    ----------
    basis : Basis
        Functions of the pulse width.
    coefficients_nm : ndarray, shape (basis.size,)
        N·m.
    """

    basis: Basis
    coefficients_nm: np.ndarray

    def __call__(self, pulse_width_us: np.ndarray) -> np.ndarray:
        """Torque at steady state for pulse widths of any shape, N·m."""
        return self.basis.design(np.asarray(pulse_width_us, float)) @ self.coefficients_nm

    def slope(self, pulse_width_us: np.ndarray) -> np.ndarray:
        """df/du, N·m/µs."""
        return self.basis.design(np.asarray(pulse_width_us, float), 1) @ self.coefficients_nm

    def table(self, tolerance: float = 2e-4, most: int = 2001) -> tuple[np.ndarray, np.ndarray]:
        """Pulse widths, µs, and torques, N·m, dense enough for linear interpolation.

        The spacing is halved until the error at the midpoints is below `tolerance` times the curve's range.
        """
        size = 151
        while True:
            u = np.linspace(0.0, self.basis.largest_us, size)
            torque = self(u)
            middle = (u[1:] + u[:-1]) / 2
            worst = np.max(np.abs(self(middle) - (torque[1:] + torque[:-1]) / 2))
            if worst <= tolerance * max(float(np.ptp(torque)), 1e-12) or 2 * size > most:
                return u, torque
            size = 2 * size - 1

    def inverse(self, size: int = 201) -> tuple[np.ndarray, np.ndarray]:
        """Torques, N·m, strictly rising from 0, and the smallest pulse width that reaches each, µs.

        The running maximum is inverted, so a curve that falls somewhere still has one answer: the smallest charge that
        gives the torque.
        """
        u, torque = self.table()
        sign = 1.0 if torque[np.argmax(np.abs(torque))] >= 0 else -1.0
        top = np.maximum.accumulate(sign * torque)
        if not top[-1] > 0.0:
            return np.zeros(1), np.zeros(1)
        level = np.linspace(0.0, float(top[-1]), size)
        reached = np.searchsorted(top, level, side="left")
        before = np.maximum(reached - 1, 0)
        rise = np.where(reached > before, top[reached] - top[before], 1.0)
        share = np.where(reached > before, (level - top[before]) / rise, 0.0)
        return sign * level, u[before] + share * (u[reached] - u[before])

    def to_dict(self) -> dict:
        return {"basis": self.basis.to_dict() | {"coefficients_nm": [float(x) for x in self.coefficients_nm]}}


def basis_from_dict(data: dict[str, Any]) -> Basis:
    """The basis that `to_dict` describes.

    Raises
    ------
    BadModel
        Its kind is unknown.
    """
    from identify.recruitment.power import PowerBasis
    from identify.recruitment.sigmoid import SigmoidBasis
    from identify.recruitment.spline import SplineBasis

    kinds = {"cubic-spline": SplineBasis, "power-series": PowerBasis, "sigmoid": SigmoidBasis}
    if data.get("kind") not in kinds:
        raise BadModel(
            f"unknown basis {data.get('kind')!r}", place="recruitment.basis.kind", fix=f"Known: {', '.join(kinds)}."
        )
    return kinds[data["kind"]].from_dict(data)

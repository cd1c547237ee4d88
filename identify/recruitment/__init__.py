"""Recruitment curves: steady-state torque as a function of pulse width, zero at zero width; inverse, landmarks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stimrig.identify.recruitment.bases import PowerBasis, SigmoidBasis, SplineBasis

THRESHOLD_SHARE = 0.05
"""At the threshold the curve has gone this share of its way to the plateau; at saturation all but this share."""


@dataclass(frozen=True)
class Curve:
    """f(u) = sum of coefficients times basis functions, N·m."""

    basis: Basis  # functions of the pulse width
    coefficients_nm: np.ndarray  # shape (basis.size,), N·m

    def __call__(self, pulse_width_us: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Torque at steady state for pulse widths of any shape, N·m, or a derivative by the pulse width, N·m/µs."""
        return self.basis.design(np.asarray(pulse_width_us, float), derivative) @ self.coefficients_nm

    def table(self, tolerance: float = 2e-4, max_points: int = 2001) -> tuple[np.ndarray, np.ndarray]:
        """Pulse widths, µs, and torques, N·m, dense enough for linear interpolation.

        The spacing is halved until the error at the midpoints is below `tolerance` times the curve's range.
        """
        size = 151
        while True:
            u = np.linspace(0.0, self.basis.largest_us, size)
            torque = self(u)
            middle = (u[1:] + u[:-1]) / 2
            worst = np.max(np.abs(self(middle) - (torque[1:] + torque[:-1]) / 2))
            if worst <= tolerance * max(float(np.ptp(torque)), 1e-12) or 2 * size > max_points:
                return u, torque
            size = 2 * size - 1

    def inverse(self) -> tuple[np.ndarray, np.ndarray]:
        """Torques, N·m, strictly rising from 0, and the smallest pulse width that reaches each, µs.

        The running maximum is inverted, so a curve that falls somewhere still has one answer: the smallest charge that
        gives the torque.
        """
        u, torque = self.table()
        sign = 1.0 if torque[np.argmax(np.abs(torque))] >= 0 else -1.0
        top = np.maximum.accumulate(sign * torque)
        if not top[-1] > 0.0:
            return np.zeros(1), np.zeros(1)
        level = np.linspace(0.0, float(top[-1]), 201)
        reached = np.searchsorted(top, level, side="left")
        before = np.maximum(reached - 1, 0)
        rise = np.where(reached > before, top[reached] - top[before], 1.0)
        share = np.where(reached > before, (level - top[before]) / rise, 0.0)
        return sign * level, u[before] + share * (u[reached] - u[before])

    def landmarks(self, covariance_nm2: np.ndarray | None = None) -> dict[str, dict[str, Any]]:
        """Threshold, plateau and saturation by name, each with `value`, `sd` and `unit`.

        A value is None if the curve does not get there; an `sd` is None without a covariance of the coefficients,
        N²·m², shape (basis.size, basis.size). Where the curve falls, its plateau is below zero.
        """
        width_us, torque_nm = self.table()
        top = int(np.argmax(np.abs(torque_nm)))
        plateau_nm = float(torque_nm[top])
        at_top = self.basis.design(width_us[top : top + 1])[0]

        def crossing(share: float) -> dict[str, Any]:
            level = share * abs(plateau_nm)
            reached = np.flatnonzero(np.sign(plateau_nm) * torque_nm[1:] >= level)
            if reached.size == 0 or level == 0.0:
                return {"value": None, "sd": None, "unit": "µs"}
            pair = slice(reached[0], reached[0] + 2)
            at_us = float(np.interp(level, np.sign(plateau_nm) * torque_nm[pair], width_us[pair]))
            place = np.array([at_us])
            # The width at which f(u) = share · plateau moves by the change of that difference over the curve's slope.
            moved = _sd(self.basis.design(place)[0] - share * at_top, covariance_nm2)
            slope = abs(float(self(place, 1)[0]))
            sd_us = moved / slope if moved is not None and slope > 0.0 else None
            return {"value": at_us, "sd": sd_us, "unit": "µs"}

        return {
            "threshold_us": crossing(THRESHOLD_SHARE),
            "plateau_nm": {"value": plateau_nm, "sd": _sd(at_top, covariance_nm2), "unit": "N·m"},
            "saturation_us": crossing(1.0 - THRESHOLD_SHARE),
        }

    def to_dict(self) -> dict:
        """As MODEL.json has it."""
        return {"basis": self.basis.to_dict() | {"coefficients_nm": [float(x) for x in self.coefficients_nm]}}


@dataclass(frozen=True)
class FixedShape:
    """A gain times a given curve, as a basis: for steps that estimate only the dynamics."""

    curve: Curve  # the shape
    size: int = field(default=1, init=False)  # of coefficients: 1

    @property
    def largest_us(self) -> float:
        """Pulse width beyond which the curve is held, µs."""
        return self.curve.basis.largest_us

    def design(self, pulse_width_us: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Values at pulse widths, µs, or a derivative; shape (..., 1)."""
        return self.curve(pulse_width_us, derivative)[..., None]

    def to_dict(self) -> dict:
        """As MODEL.json has it."""
        return self.curve.to_dict()


Basis = SplineBasis | PowerBasis | SigmoidBasis | FixedShape
"""The basis functions of one kind of recruitment curve; all are zero at zero pulse width."""


def _sd(slopes: np.ndarray, covariance: np.ndarray | None) -> float | None:
    return None if covariance is None else float(np.sqrt(max(slopes @ covariance @ slopes, 0.0)))

"""Threshold, plateau and saturation of a recruitment curve, with their standard deviations."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.recruitment.curve import Curve

THRESHOLD_SHARE = 0.05
"""At the threshold the curve has gone this share of its way to the plateau; at saturation all but this share."""


def landmarks(curve: Curve, covariance_nm2: np.ndarray | None = None) -> dict[str, dict[str, Any]]:
    """The landmarks by name, each with `value`, `sd` and `unit`.

    A value is None if the curve does not get there; an `sd` is None without a covariance of the coefficients.

    Parameters
    ----------
    curve : Curve
        f(u); where it falls, its plateau is below zero.
    covariance_nm2 : ndarray, shape (basis.size, basis.size), optional
        Covariance of the coefficients, N²·m².
    """
    width_us, torque_nm = curve.table()
    top = int(np.argmax(np.abs(torque_nm)))
    plateau_nm = float(torque_nm[top])
    at_top = curve.basis.design(width_us[top : top + 1])[0]

    def crossing(share: float) -> dict[str, Any]:
        at_us = _crossing(width_us, torque_nm, share * plateau_nm)
        if at_us is None:
            return _estimate(None, None, "µs")
        place = np.array([at_us])
        # The width at which f(u) = share · plateau moves by the change of that difference over the curve's slope.
        moved = _sd(curve.basis.design(place)[0] - share * at_top, covariance_nm2)
        slope = abs(float(curve.slope(place)[0]))
        return _estimate(at_us, moved / slope if moved is not None and slope > 0.0 else None, "µs")

    return {
        "threshold_us": crossing(THRESHOLD_SHARE),
        "plateau_nm": _estimate(plateau_nm, _sd(at_top, covariance_nm2), "N·m"),
        "saturation_us": crossing(1.0 - THRESHOLD_SHARE),
    }


def _crossing(width_us: np.ndarray, torque_nm: np.ndarray, level_nm: float) -> float | None:
    """The first width at which the curve reaches a torque, linear between the table's rows."""
    sign = 1.0 if level_nm >= 0 else -1.0
    reached = np.flatnonzero(sign * torque_nm[1:] >= sign * level_nm)
    if reached.size == 0 or level_nm == 0.0:
        return None
    first = int(reached[0])
    low, high = torque_nm[first], torque_nm[first + 1]
    share = (level_nm - low) / (high - low)
    return float(width_us[first] + share * (width_us[first + 1] - width_us[first]))


def _sd(slopes: np.ndarray, covariance: np.ndarray | None) -> float | None:
    return None if covariance is None else float(np.sqrt(max(slopes @ covariance @ slopes, 0.0)))


def _estimate(value: float | None, sd: float | None, unit: str) -> dict[str, Any]:
    return {"value": value, "sd": sd, "unit": unit}

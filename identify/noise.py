"""Noise on the measured torque: white, or correlated from one pulse interval to the next."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

LARGEST_AR1 = 0.995


def whiten(rows: np.ndarray, stretches: list[slice], ar1: float) -> np.ndarray:
    """Rows of AR(1) noise made white, exactly, stretch by stretch.

    Parameters
    ----------
    rows : ndarray, shape (K,) or (K, M)
        Residuals or design columns on the grid.
    stretches : list of slice
        Runs of fitted rows; correlation does not cross from one to the next.
    ar1 : float
        Correlation of neighbours, -1 < ar1 < 1.

    Returns
    -------
    ndarray
        Fitted rows only, in order; the first of each stretch is scaled by sqrt(1 - ar1²), so that the determinant of
        the likelihood is that of the stationary process.
    """
    parts = []
    for stretch in stretches:
        block = rows[stretch]
        out = block.copy()
        out[1:] -= ar1 * block[:-1]
        out[0] *= np.sqrt(1.0 - ar1 * ar1)
        parts.append(out)
    return np.concatenate(parts)


def log_likelihood(residual: np.ndarray, stretches: list[slice], ar1: float) -> float:
    """Exact Gaussian AR(1) log-likelihood with the innovation's variance profiled out.

    Parameters
    ----------
    residual : ndarray, shape (K,)
        Residual on the grid, N·m.
    stretches : list of slice
        Runs of fitted rows.
    ar1 : float
        Correlation of neighbours.
    """
    white = whiten(residual, stretches, ar1)
    variance = max(float(white @ white) / white.size, 1e-24)
    jacobian = 0.5 * len(stretches) * np.log1p(-ar1 * ar1)
    return -0.5 * white.size * (np.log(2 * np.pi * variance) + 1.0) + jacobian


def best_ar1(residual: np.ndarray, stretches: list[slice]) -> float:
    """Correlation of neighbours that makes the residual most likely, in [-0.5, LARGEST_AR1]."""
    found = minimize_scalar(
        lambda ar1: -log_likelihood(residual, stretches, ar1),
        bounds=(-0.5, LARGEST_AR1),
        method="bounded",
        options={"xatol": 1e-4},
    )
    return float(found.x)

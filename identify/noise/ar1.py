"""Noise on the measured torque: white, or correlated from one pulse interval to the next."""

from __future__ import annotations

import numpy as np

LARGEST_AR1 = 0.995


def whiten(rows: np.ndarray, stretches: list[slice], ar1: float) -> np.ndarray:
    """Whiten rows of AR(1) noise exactly, stretch by stretch.

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
        The fitted rows in order. The first of each stretch is scaled by sqrt(1 - ar1²), so that the likelihood is that
        of the stationary process.
    """
    if ar1 == 0.0:
        parts = [rows[stretch] for stretch in stretches]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)
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
    lead = sum(float(residual[s] @ residual[s]) for s in stretches)
    lag = sum(float(residual[s][1:] @ residual[s][:-1]) for s in stretches)
    inner = sum(float(residual[s][1:-1] @ residual[s][1:-1]) for s in stretches)
    rows = sum(s.stop - s.start for s in stretches)

    def score(ar1: np.ndarray) -> np.ndarray:
        squares = np.maximum(lead - 2 * ar1 * lag + ar1 * ar1 * inner, 1e-24 * rows)
        return -0.5 * rows * np.log(squares) + 0.5 * len(stretches) * np.log1p(-ar1 * ar1)

    low, high, found = -0.5, LARGEST_AR1, 0.0
    for _ in range(3):  # the score has one maximum: three scans, each finer, find it to 1e-5
        trial = np.linspace(low, high, 61)
        best = int(np.argmax(score(trial)))
        low, high, found = float(trial[max(best - 1, 0)]), float(trial[min(best + 1, 60)]), float(trial[best])
    return found


def ar1_or_white(residual: np.ndarray, stretches: list[slice]) -> tuple[float, float]:
    """Choose AR(1) or white noise: the correlation (0 for white), and ΔBIC (positive in favour of AR(1)).

    Parameters
    ----------
    residual : ndarray, shape (K,)
        Residual on the grid, N·m.
    stretches : list of slice
        Runs of fitted rows.
    """
    ar1 = best_ar1(residual, stretches)
    rows = sum(s.stop - s.start for s in stretches)
    gain = log_likelihood(residual, stretches, ar1) - log_likelihood(residual, stretches, 0.0)
    delta_bic = 2 * gain - float(np.log(max(rows, 2)))
    return (ar1 if delta_bic > 0 else 0.0), delta_bic

"""Statistics of a fit: best-fit %, error, white noise, and the best fit that the noise allows."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.pulse_grid import Grid

CONSTANT = 1e-9
"""Torque whose standard deviation is below this (N·m, or share of its size) is constant, but for rounding."""
NOISE_SHARE = 0.5
"""Torque whose standard deviation is below this share of that of the noise is constant, too."""
UNDEFINED = "not defined, since the torque is constant there"


def best_fit_percent(measured_nm: np.ndarray, predicted_nm: np.ndarray, noise_sd_nm: float = 0.0) -> float:
    """100 (1 - ||y - ŷ|| / ||y - mean y||), as in the paper; NaN (null in JSON) if the torque is constant."""
    if is_constant(measured_nm, noise_sd_nm):
        return float("nan")
    spread = float(np.linalg.norm(measured_nm - np.mean(measured_nm)))
    return 100.0 * (1.0 - float(np.linalg.norm(measured_nm - predicted_nm)) / spread)


def is_constant(measured_nm: np.ndarray, noise_sd_nm: float = 0.0) -> bool:
    """Whether the torque is constant: then its fit in per cent is not defined."""
    if not measured_nm.size:
        return True
    largest = float(np.max(np.abs(measured_nm)))
    spread = float(np.std(measured_nm))
    return not spread > max(CONSTANT * max(largest, 1.0), NOISE_SHARE * noise_sd_nm)


def rms(residual_nm: np.ndarray) -> float:
    """Root mean square, N·m."""
    return float(np.sqrt(np.mean(residual_nm**2))) if residual_nm.size else float("nan")


def white_sd(grid: Grid, predicted_nm: np.ndarray, block_sd_nm: float, freedom: float, white: bool) -> float:
    """White measurement noise at the record's own rate, N·m.

    If the residual is white on the grid of pulses, and as large as white samples make it, the whole residual is used,
    which is efficient. Otherwise it contains something slower (a missing effect, correlated noise, hum), and the noise
    is estimated from second differences, which slow parts hardly change.

    Parameters
    ----------
    grid : Grid
        The record.
    predicted_nm : ndarray, shape (N,)
        Torque of the model, N·m.
    block_sd_nm : float
        Standard deviation of the residual on the grid.
    freedom : float
        Effective number of parameters.
    white : bool
        Whether the residual on the grid is white rather than correlated.
    """
    rows = grid.fitted[grid.interval] & ~grid.record.held_out
    residual = grid.record.torque_nm - predicted_nm
    used = residual[rows]
    plain = float(np.sqrt(used @ used / max(used.size - freedom, 1.0)))
    jump = np.diff(residual, 2)[rows[2:] & rows[1:-1] & rows[:-2]]
    if white and abs(block_sd_nm * np.sqrt(np.median(grid.count[grid.fitted])) / max(plain, 1e-300) - 1.0) < 0.2:
        return plain
    return plain if jump.size < 16 else float(min(np.sqrt(np.mean(jump**2) / 6.0), plain))


def ceiling_percent(measured_nm: np.ndarray, sd_nm: float) -> float:
    """Best-fit % that the true system would reach on this record: 100 (1 - ||noise|| / ||y - mean y||)."""
    if is_constant(measured_nm, sd_nm):
        return float("nan")
    return 100.0 * (1.0 - sd_nm / float(np.std(measured_nm)))


def figures(measured_nm: np.ndarray, predicted_nm: np.ndarray, sd_nm: float, prefix: str = "") -> dict[str, float]:
    """Best fit, the best one that the noise allows, and error of some rows."""
    return {
        f"{prefix}fit_percent": best_fit_percent(measured_nm, predicted_nm, sd_nm),
        f"{prefix}ceiling_percent": ceiling_percent(measured_nm, sd_nm),
        f"{prefix}rms_nm": rms(measured_nm - predicted_nm),
    }


def fit_statistics(
    grid: Grid, rows: np.ndarray, predicted_nm: np.ndarray, sd_nm: float, held_out_change: np.ndarray | None = None
) -> dict[str, Any]:
    """The key `fit` of MODEL.json, computed at the record's samples.

    Percentages are NaN if the torque is constant. Doubted samples are not counted.

    Parameters
    ----------
    grid : Grid
        The record.
    rows : ndarray of bool, shape (K,)
        Fitted intervals.
    predicted_nm : ndarray, shape (N,)
        Torque of the model, N·m.
    sd_nm : float
        White noise of a sample, N·m.
    held_out_change : ndarray or None, shape (K,)
        For a record without `validate`: see `held_out_change`, N·m.
    """
    record = grid.record
    measured = record.torque_nm
    used = rows[grid.interval] & ~record.held_out & grid.counted
    held = record.held_out & grid.counted
    result: dict[str, Any] = {
        **figures(measured[used], predicted_nm[used], sd_nm),
        "noise_sd_nm": sd_nm,
        "held_out_fit_percent": None,
        "held_out_ceiling_percent": None,
        "held_out_rms_nm": None,
        "held_out_by": "none",
        "samples": int(used.sum()),
        "held_out_samples": int(held.sum()),
        "segments": segment_statistics(grid, predicted_nm, sd_nm),
    }
    if held.any():
        result |= figures(measured[held], predicted_nm[held], sd_nm, "held_out_") | {"held_out_by": "validate"}
    elif held_out_change is not None:
        left_out = predicted_nm[used] + held_out_change[grid.interval[used]]
        result |= figures(measured[used], left_out, sd_nm, "held_out_")
        result |= {"held_out_by": "cross-validation", "held_out_samples": int(used.sum())}
    return result


def segment_statistics(grid: Grid, predicted_nm: np.ndarray, sd_nm: float) -> list[dict[str, Any]]:
    """Fit and ceiling of each segment, in order, without doubted samples."""
    record, rows = grid.record, []
    edges = np.searchsorted(record.segment, np.arange(len(record.segment_names) + 1))
    for name, start, end in zip(record.segment_names, edges[:-1], edges[1:], strict=True):
        counted = grid.counted[start:end]
        measured, predicted = record.torque_nm[start:end][counted], predicted_nm[start:end][counted]
        rows.append(
            {
                "segment": name,
                "start_s": float(record.time_s[start]),
                "end_s": float(record.time_s[end - 1]),
                "rms_nm": rms(measured - predicted),
                "fit_percent": best_fit_percent(measured, predicted, sd_nm),
                "ceiling_percent": ceiling_percent(measured, sd_nm),
            }
        )
    return rows

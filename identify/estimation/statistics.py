"""Errors of a fitted candidate at the record's samples: fitted rows, held-out rows, or blocked cross-validation."""

from __future__ import annotations

import numpy as np

from identify.estimation.joint import Fitted, solve
from identify.estimation.to_model import predict_fitted
from identify.records.record import Record
from identify.simulation.problem import Problem

FOLDS = 4


def fit_percent(torque_nm: np.ndarray, predicted_nm: np.ndarray) -> float:
    """100 (1 - ||y - ŷ|| / ||y - mean y||), as in the paper."""
    spread = float(np.linalg.norm(torque_nm - torque_nm.mean()))
    return float(100.0 * (1.0 - np.linalg.norm(torque_nm - predicted_nm) / max(spread, 1e-12)))


def figures(fitted: Fitted, record: Record, predicted_nm: np.ndarray | None = None) -> dict[str, float | str | None]:
    """Fit and error on fitted and on held-out rows, and the ceiling that noise sets."""
    predicted = predict_fitted(fitted, record) if predicted_nm is None else predicted_nm
    grid = fitted.problem.setup.grid
    used = fitted.problem.setup.fitted[grid.interval] & ~record.held_out
    torque, noise = record.torque_nm, fitted.problem.setup.noise_sd_nm
    held, guess = record.held_out & grid.counted, predicted
    source = "validate"
    if not held.any():
        guess, held = cross_validated(fitted, record), used
        source = "blocked cross-validation"
    spread = float(np.std(torque[used]))
    return {
        "fit_percent": fit_percent(torque[used], predicted[used]),
        "held_out_fit_percent": fit_percent(torque[held], guess[held]),
        "rms_nm": rms(torque[used] - predicted[used]),
        "held_out_rms_nm": rms(torque[held] - guess[held]),
        "ceiling_percent": 100.0 * (1.0 - noise / max(spread, 1e-12)),
        "held_out_ceiling_percent": 100.0 * (1.0 - noise / max(float(np.std(torque[held])), 1e-12)),
        "noise_sd_nm": noise,
        "held_out": source,
    }


def cross_validated(fitted: Fitted, record: Record) -> np.ndarray:
    """Prediction of each sample by a model fitted without its block; blocks are contiguous quarters of every part."""
    setup = fitted.problem.setup
    result = np.zeros(record.time_s.size)
    fold = _folds(setup.fitted)
    for number in range(FOLDS):
        kept = setup.with_(fitted=setup.fitted & (fold != number))
        problem = Problem(kept, fitted.effects)
        found = solve(problem, fitted.theta, fitted.noise, most=6, tolerance=0.3)
        rows = fold[setup.grid.interval] == number
        result[rows] = problem.at_samples(found.theta)[rows]
    return result


def _folds(fitted: np.ndarray) -> np.ndarray:
    """Folds of a second or so in turn, so that each fold holds a piece of every part."""
    piece = max(int(fitted.sum() / (FOLDS * 6)), 40)
    count = np.cumsum(fitted) - 1
    return (count // piece) % FOLDS


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0

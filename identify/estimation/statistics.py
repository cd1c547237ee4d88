"""Errors of a fitted candidate at the record's samples: fitted rows, held-out rows, or blocked cross-validation."""

from __future__ import annotations

import numpy as np

from identify.estimation.figures import best_fit_percent, ceiling_percent, rms
from identify.estimation.joint import Fitted, solve
from identify.estimation.to_model import predict_fitted
from identify.records.record import Record
from identify.simulation.problem import Problem

FOLDS = 4


def figures(fitted: Fitted, record: Record, predicted_nm: np.ndarray | None = None) -> dict[str, float | str | None]:
    """Fit and error on fitted and on held-out rows, and the ceiling that noise sets; NaN where the torque is level."""
    predicted = predict_fitted(fitted, record) if predicted_nm is None else predicted_nm
    used = fitted.problem.setup.fitted[fitted.problem.setup.grid.interval] & ~record.held_out
    torque, noise = record.torque_nm, fitted.problem.setup.noise_sd_nm
    held, guess = record.held_out, predicted
    source = "validate"
    if not held.any():
        guess, held = cross_validated(fitted, record), used
        source = "blocked cross-validation"
    return {
        "fit_percent": best_fit_percent(torque[used], predicted[used], noise),
        "held_out_fit_percent": best_fit_percent(torque[held], guess[held], noise),
        "rms_nm": rms(torque[used] - predicted[used]),
        "held_out_rms_nm": rms(torque[held] - guess[held]),
        "ceiling_percent": ceiling_percent(torque[used], noise),
        "held_out_ceiling_percent": ceiling_percent(torque[held], noise),
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

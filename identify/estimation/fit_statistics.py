"""Statistics of a fit: best-fit %, error, white noise, the best fit that the noise allows, and held-out pulses."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid, ends_of
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.repetition import repetition
from stimrig.identify.estimation.samples import block_means
from stimrig.identify.estimation.solve import Fitted, once, predict_fitted
from stimrig.identify.noise import whitened
from stimrig.identify.records.readings import contrasts
from stimrig.identify.records.record import HELD_OUT

CONSTANT = 1e-9
"""Torque whose standard deviation is below this (N·m, or share of its size) is constant, but for rounding."""
NOISE_SHARE = 0.5
"""Torque whose standard deviation is below this share of that of the noise is constant, too."""
BEYOND_NOISE = 1.5
"""A residual of so many times the noise that the samples show is not noise alone, however white it is."""
UNDEFINED = "not defined, since the torque is constant there"


def best_fit_percent(measured_nm: np.ndarray, predicted_nm: np.ndarray, noise_sd_nm: float = 0.0) -> float:
    """100 (1 - ||y - ŷ|| / ||y - mean y||), as in the paper; NaN (null in JSON) if the torque is constant."""
    if is_constant(measured_nm, noise_sd_nm):
        return float("nan")
    spread = float(np.linalg.norm(measured_nm - np.mean(measured_nm)))
    return 100.0 * (1.0 - float(np.linalg.norm(measured_nm - predicted_nm)) / spread)


def is_constant(measured_nm: np.ndarray, noise_sd_nm: float = 0.0) -> bool:
    """Return True if the torque is constant: then its fit in per cent is not defined."""
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

    If the residual is white on the grid of pulses (`white`), as large as white samples make it, and hardly more than
    the samples show before any fit, the whole residual is used, which is efficient. Otherwise it contains something
    else (a missing effect, correlated noise, hum), and the noise is estimated from second differences, which slow parts
    hardly change.

    `block_sd_nm`: standard deviation of the residual on the grid. `freedom`: effective number of parameters.
    """
    rows = grid.fitted[grid.interval] & ~grid.record.held_out
    residual = grid.record.torque_nm - predicted_nm
    used = residual[rows]
    plain = float(np.sqrt(used @ used / max(used.size - freedom, 1.0)))
    if grid.readings is None:
        jump, known = np.diff(residual, 2) / np.sqrt(6.0), rows
    else:
        at = grid.readings.at
        jump, known = contrasts(at, residual[at], 2), rows[at]
    jump = jump[known[2:] & known[1:-1] & known[:-2]]
    consistent = abs(block_sd_nm * np.sqrt(grid.readings_in(grid.fitted)) / max(plain, 1e-300) - 1.0) < 0.2
    if white and consistent and plain < BEYOND_NOISE * grid.noise_sd_nm:
        return plain
    return plain if jump.size < 16 else float(min(np.sqrt(np.mean(jump**2)), plain))


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
    grid: Grid,
    rows: np.ndarray,
    predicted_nm: np.ndarray,
    sd_nm: float,
    held_out_change: np.ndarray | None = None,
    predictable_nm: np.ndarray | None = None,
    unforeseen_nm: np.ndarray | float = 0.0,
) -> dict[str, Any]:
    """The key `fit` of MODEL.json, computed at the record's samples.

    Percentages are NaN if the torque is constant. Doubted samples are not counted.

    `rows`: fitted intervals. `sd_nm`: white noise of a sample. `held_out_change`: of fitted intervals where they are
    left out of the fit, N·m: see the function of that name. `predictable_nm`: torque without the effects that cannot be
    predicted; the held-out figures are computed with it. `unforeseen_nm`: size of the torque that it lacks. In the
    ceiling this counts as noise, since it is known and does not come from the muscle; it is at most the error beyond
    noise there, so that a misplaced effect does not lower the ceiling.
    """
    record = grid.record
    measured = record.torque_nm
    judged_nm = predicted_nm if predictable_nm is None else predictable_nm
    used = rows[grid.interval] & ~record.held_out & grid.counted
    judged = record.held_out & grid.counted
    result: dict[str, Any] = {
        **figures(measured[used], predicted_nm[used], sd_nm),
        "noise_sd_nm": sd_nm,
        **dict.fromkeys(("held_out_fit_percent", "held_out_ceiling_percent", "held_out_rms_nm")),
        "held_out_by": "none",
        "samples": int(used.sum()),
        "held_out_samples": int(judged.sum()),
        "segments": segment_statistics(grid, np.where(record.held_out, judged_nm, predicted_nm), sd_nm),
    }
    left_out, by = judged_nm, HELD_OUT
    if held_out_change is not None:
        left_out = judged_nm + held_out_change[grid.interval]
        judged, by = (judged, by) if judged.any() else (used, "cross-validation")
    if judged.any():
        beside_noise = rms((measured - left_out)[judged]) ** 2 - sd_nm**2
        lacking_nm = rms(np.broadcast_to(unforeseen_nm, measured.shape)[judged])
        unpredictable_nm = min(lacking_nm, float(np.sqrt(max(beside_noise, 0.0))))
        result |= figures(measured[judged], left_out[judged], float(np.hypot(sd_nm, unpredictable_nm)), "held_out_")
        result |= {"held_out_by": by, "held_out_samples": int(judged.sum())}
        result |= {"unforeseen_nm": unpredictable_nm} if unpredictable_nm > 0.0 else {}
    return result | {"repetition": repetition(grid, block_means(grid, measured - left_out), rows)}


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


BLOCK_S = 2.0
FOLDS = 5


def evaluate(fitted: Fitted) -> dict[str, Any]:
    """The key `fit` of MODEL.json: errors, best-fit %, and the best fit that the noise allows."""
    setup = fitted.problem.setup
    grid = setup.grid
    one_fold = setup.fitted.sum() < fold_rows(grid)  # without it nothing is left to fit
    change = None if one_fold else held_out_change(fitted)
    predicted, *foreseen = predict_fitted(fitted)
    noise = white_sd(grid, predicted, fitted.noise.sd_nm, fitted.freedom, fitted.noise.is_white)
    statistics = fit_statistics(grid, setup.fitted, predicted, noise, change, *foreseen)
    return statistics | {"log_evidence": fitted.log_evidence, "log_likelihood": fitted.log_likelihood}


def fold_rows(grid: Grid) -> int:
    """Return the number of fitted intervals in a block of a fold."""
    return max(round(BLOCK_S / grid.step_s), 2)


@once  # the statistics of a model and its covariance both ask for it
def held_out_change(fitted: Fitted) -> np.ndarray:
    """Change of the predicted torque in each fitted interval when its fold is left out of the fit, N·m, shape (K,).

    Blocks of 2 s are assigned to five folds in turn. The refit without a fold is one Gauss-Newton step from the
    solution, with the same noise: exact for all linear parameters (recruitment, baseline), first order for the others.
    The initial state of the record is kept, since it could not be found without the first seconds, and what an effect
    that cannot be foreseen adds is no part of it. The resulting error is one of prediction, as on `validate`; it is not
    whitened.
    """
    problem = fitted.problem
    setup, grid = problem.setup, problem.setup.grid
    rows = setup.fitted
    fold = (np.cumsum(rows) // fold_rows(grid)) % FOLDS
    refitted = np.delete(np.arange(problem.size), problem.initials)
    mean, precision = problem.prior
    pull = (precision @ (fitted.theta - mean))[refitted]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fitted.hessian)[refitted], 1e-300))
    slopes = fitted.slopes[refitted] * scale[:, None]
    penalty = precision[np.ix_(refitted, refitted)] * scale[:, None] * scale[None, :] + 1e-9 * np.eye(refitted.size)
    both = np.vstack([np.where(rows, fitted.residual_nm, 0.0), slopes]) / setup.spread
    predictable = np.ones(problem.size, bool)
    for chosen in problem.chosen:
        predictable[chosen.places] = find_effect(chosen.effect).predictable
    change = np.zeros(grid.size)
    for number in range(FOLDS):
        left_out = rows & (fold == number)
        if not left_out.any() or left_out.sum() == rows.sum():
            continue
        white = whitened(both, ends_of(grid.stretches(rows & ~left_out)), fitted.noise)
        step = np.linalg.solve(white[1:] @ white[1:].T + penalty, white[1:] @ white[0] - scale * pull)
        change[left_out] = (step * predictable[refitted]) @ slopes[:, left_out]
    return change

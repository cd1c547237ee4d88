"""The fit statistics of a fitted candidate: on fitted rows, and on held-out rows or by blocked cross-validation."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.pulse_grid import ends_of
from stimrig.identify.estimation.band_effect import predict_fitted
from stimrig.identify.estimation.fit_statistics import fit_statistics, white_sd
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.noise.level import whitened

BLOCK_S = 2.0
FOLDS = 5


def evaluate(fitted: Fitted) -> dict[str, Any]:
    """The key `fit` of MODEL.json: errors, best-fit %, and the best fit that the noise allows."""
    setup = fitted.problem.setup
    grid = setup.grid
    predicted = predict_fitted(fitted)
    noise = white_sd(grid, predicted, fitted.noise.sd_nm, fitted.freedom, fitted.noise.is_white)
    change = None if grid.record.has_held_out else held_out_change(fitted)
    found = fit_statistics(grid, setup.fitted, predicted, noise, change)
    return found | {"log_evidence": fitted.log_evidence, "log_likelihood": fitted.log_likelihood}


def held_out_change(fitted: Fitted) -> np.ndarray:
    """Change of the predicted torque in each fitted interval when its fold is left out of the fit, N·m, shape (K,).

    Blocks of 2 s are assigned to five folds in turn. The refit without a fold is one Gauss-Newton step from the
    solution, with the same noise: exact for all linear parameters (recruitment, baseline), first order for the others.
    The initial state of the record is kept, since it could not be found without the first seconds. The resulting error
    is an error of prediction, as on `validate`; it is not whitened.
    """
    problem = fitted.problem
    setup, grid = problem.setup, problem.setup.grid
    rows = setup.fitted
    block = max(round(BLOCK_S / grid.step_s), 2)
    fold = (np.cumsum(rows) // block) % FOLDS
    kept = np.delete(np.arange(problem.size), problem.initials)
    mean, precision = problem.prior
    pull = (precision @ (fitted.theta - mean))[kept]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fitted.hessian)[kept], 1e-300))
    slopes = fitted.slopes[kept] * scale[:, None]
    penalty = precision[np.ix_(kept, kept)] * scale[:, None] * scale[None, :] + 1e-9 * np.eye(kept.size)
    both = np.vstack([np.where(rows, fitted.residual_nm, 0.0), slopes]) / setup.spread
    change = np.zeros(grid.size)
    for number in range(FOLDS):
        left_out = rows & (fold == number)
        if not left_out.any() or left_out.sum() == rows.sum():
            continue
        white = whitened(both, ends_of(grid.stretches(rows & ~left_out)), fitted.noise)
        step = np.linalg.solve(white[1:] @ white[1:].T + penalty, white[1:] @ white[0] - scale * pull)
        change[left_out] = step @ slopes[:, left_out]
    return change

"""Held-out figures for a record without `validate`: blocked cross-validation around the solution."""

from __future__ import annotations

import numpy as np

from identify.estimation.joint import Fitted

BLOCK_S = 2.0
FOLDS = 5


def held_out_change(fitted: Fitted) -> np.ndarray:
    """By how much each fitted row's block mean changes when its fold isn't fitted, N·m, shape (K,).

    Blocks of 2 s go to five folds in turn. The refit without a fold is one Gauss-Newton step from the solution: exact
    in all that is linear (recruitment, baseline), first order in the rest. The state in which the record begins is
    kept: without its first seconds nobody would predict it backwards.
    """
    problem = fitted.problem
    setup, grid = problem.setup, problem.setup.grid
    rows = setup.fitted
    block = max(round(BLOCK_S / grid.step_s), 2)
    fold = (np.cumsum(rows) // block) % FOLDS
    kept = np.delete(np.arange(problem.size), problem.initials)
    mean, precision = problem.prior
    penalty = precision[np.ix_(kept, kept)] * fitted.noise.sd_nm**2
    slopes = fitted.slopes[kept]
    whole = slopes[:, rows] @ slopes[:, rows].T + penalty
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
    design = slopes.T * scale
    whole = whole * scale[:, None] * scale[None, :]
    residual = np.where(rows, fitted.residual_nm, 0.0)
    gradient = design[rows].T @ residual[rows] - scale * (penalty @ (fitted.theta - mean)[kept])
    change = np.zeros(grid.size)
    for number in range(FOLDS):
        left_out = rows & (fold == number)
        if not left_out.any() or left_out.sum() == rows.sum():
            continue
        out = design[left_out]
        left = whole - out.T @ out
        step = np.linalg.solve(left + 1e-9 * np.eye(len(left)), gradient - out.T @ residual[left_out])
        change[left_out] = out @ step
    return change

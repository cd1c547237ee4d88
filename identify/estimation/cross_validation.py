"""Held-out figures for a record without `validate`: blocked cross-validation around the solution."""

from __future__ import annotations

import numpy as np

from identify.estimation.projected import Solution

BLOCK_S = 2.0
FOLDS = 5


def held_out_change(solution: Solution) -> np.ndarray:
    """By how much each fitted row's block mean changes when its fold isn't fitted, N·m, shape (K,).

    Blocks of 2 s go to five folds in turn. The refit without a fold is one Gauss-Newton step from the solution:
    exact in all that is linear (recruitment, baseline), first order in the dynamics.
    """
    problem, grid = solution.problem, solution.problem.grid
    block = max(round(BLOCK_S / grid.step_s), 2)
    fold = (np.cumsum(problem.rows) // block) % FOLDS
    design = np.concatenate([solution.columns, solution.slopes], axis=1)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(solution.gram), 1e-300))
    design = design * scale
    residual = np.where(problem.rows, solution.residual_nm, 0.0)
    penalty = np.zeros_like(solution.gram)
    size = problem.basis.size
    penalty[:size, :size] = solution.weight * problem.roughness
    penalty = penalty * scale[:, None] * scale[None, :]
    fitted = design[problem.rows]
    whole = fitted.T @ fitted + penalty
    gradient = fitted.T @ residual[problem.rows]
    start = penalty[:, :size] @ (solution.coefficients[:size] / scale[:size])
    change = np.zeros(grid.size)
    for number in range(FOLDS):
        rows = problem.rows & (fold == number)
        if not rows.any() or rows.sum() == problem.rows.sum():
            continue
        out = design[rows]
        left = whole - out.T @ out
        step = np.linalg.solve(left + 1e-9 * np.eye(len(left)), gradient - out.T @ residual[rows] - start)
        change[rows] = out @ step
    return change

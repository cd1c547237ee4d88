"""Covariance of the parameters that also holds what the model has a little wrong: by blocks of the record.

If the model is right, the gradients of the log likelihood by blocks vary as much as the information says. What the
model has wrong lasts longer than a sample and makes them vary more (White 1982; Liang and Zeger 1986, clusters).
"""

from __future__ import annotations

import numpy as np

from identify.estimation.joint import Fitted
from identify.noise.level import whitened

BLOCK_S = 3.0
"""Longer than a contraction's rise: within a block, what is wrong stays wrong."""


def clustered_covariance(fitted: Fitted) -> np.ndarray:
    """At least the usual covariance of the parameters, in their units, shape (P, P)."""
    problem, setup = fitted.problem, fitted.problem.setup
    rows = np.vstack([fitted.residual_nm, fitted.slopes]) / setup.spread
    white = whitened(rows, setup.stretches, fitted.noise)
    at = np.concatenate([np.arange(start, stop) for start, stop in zip(*setup.stretches, strict=True)])
    block = (at * setup.grid.step_s / BLOCK_S).astype(np.int64) + 10**6 * setup.grid.part[at]
    borders = np.flatnonzero(np.r_[True, block[1:] != block[:-1]])
    gradients = np.add.reduceat(white[1:] * white[0], borders, axis=1)
    information = white[1:] @ white[1:].T
    more = gradients @ gradients.T
    inverse = np.linalg.pinv(fitted.hessian, hermitian=True)
    values, vectors = np.linalg.eigh(inverse @ (more - information) @ inverse)
    wider = (vectors * np.maximum(values, 0.0)) @ vectors.T
    slope = np.where(problem.log, fitted.physical, 1.0)
    return (inverse + wider) * slope[:, None] * slope[None, :]

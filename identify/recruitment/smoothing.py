"""Smoothness of a recruitment curve: the penalty's weight from the data, by restricted maximum likelihood (REML)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

LOWEST, HIGHEST = 1e-9, 1e9
"""Bounds of the weight, relative to the balance of data and penalty."""


@dataclass(frozen=True)
class Choice:
    """A penalty's weight.

    Parameters
    ----------
    weight : float
        Factor of the roughness in the sum of squares, N²m² per unit of roughness.
    variance : float
        Noise variance at that weight, N²m².
    """

    weight: float
    variance: float


def straight_lines(roughness: np.ndarray) -> int:
    """Dimension of the shapes that are not penalised."""
    values = np.linalg.eigvalsh(roughness)
    return int(np.sum(values <= 1e-13 * max(float(values[-1]), 1e-300)))


def choose_weight(
    gram: np.ndarray,
    moment: np.ndarray,
    energy: float,
    rows: int,
    roughness: np.ndarray,
    free: int = 0,
    null: int | None = None,
) -> Choice:
    """The weight of the penalty in min ||y - Z c||² + weight c'Rc that makes the data most likely (REML).

    The penalty is taken as a prior, the coefficients are integrated out, and the noise variance is profiled (Wahba
    1985; Wood 2011). One eigendecomposition serves all weights.

    Parameters
    ----------
    gram, moment, energy : ndarray (P, P), ndarray (P,), float
        Z'Z, Z'y and y'y of whitened rows; columns without a penalty are already projected out.
    rows : int
        Number of rows.
    roughness : ndarray, shape (P, P)
        R.
    free : int
        Number of columns that were projected out.
    null : int, optional
        `straight_lines(roughness)`, if it is known already.
    """
    # This dimension is computed from the penalty, not from the data, which do not cover all shapes.
    straight = straight_lines(roughness) if null is None else null
    freedom_left = max(rows - free - straight, 1)
    weight, left = _weighed(gram, moment, energy, freedom_left, roughness, straight)
    return Choice(weight, left / freedom_left)


@njit(cache=True, nogil=True)
def _weighed(gram, moment, energy, freedom_left, roughness, straight):  # pragma: no cover
    size = len(gram)
    balance = np.trace(gram) / max(np.trace(roughness), 1e-300)
    floor = 1e-11 * balance
    root = np.linalg.cholesky(gram + floor * roughness + 1e-13 * np.trace(gram) / size * np.eye(size))
    inverse = np.linalg.inv(root)
    half = inverse @ roughness @ inverse.T
    bent, turn = np.linalg.eigh((half + half.T) / 2)
    bent = np.maximum(bent, 0.0)
    part = (turn.T @ (inverse @ moment)) ** 2
    weight = balance * np.exp(np.linspace(np.log(LOWEST), np.log(HIGHEST), 73))
    score = np.empty(weight.size)
    for i in range(weight.size):
        bottom = np.maximum(1.0 + (weight[i] - floor) * bent, 1e-12)
        squares = max(energy - (part / bottom).sum(), 1e-14 * energy + 1e-300)
        score[i] = -freedom_left * np.log(squares) - np.log(bottom).sum() + (size - straight) * np.log(weight[i])
    best = int(np.argmax(score))
    chosen = weight[best]
    if 0 < best < weight.size - 1:  # the top of the parabola through three points
        below, here, above = score[best - 1], score[best], score[best + 1]
        shift = 0.5 * (below - above) / min(below - 2 * here + above, -1e-12)
        chosen = weight[best] * (weight[1] / weight[0]) ** shift
    bottom = np.maximum(1.0 + (chosen - floor) * bent, 1e-12)
    left = max(energy - (part / bottom).sum(), 1e-14 * energy)
    return chosen, left

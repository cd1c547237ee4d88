"""How smooth a recruitment curve must be: the penalty's weight from the data, by restricted marginal likelihood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LOWEST, HIGHEST = 1e-9, 1e9
"""Bounds of the weight, relative to the balance of data and penalty."""


@dataclass(frozen=True)
class Choice:
    """A penalty's weight.

    Parameters
    ----------
    weight : float
        Factor of the roughness in the sum of squares, N²m² per unit of roughness.
    freedom : float
        Effective number of coefficients.
    variance : float
        Noise variance at that weight, N²m².
    """

    weight: float
    freedom: float
    variance: float


def straight_lines(roughness: np.ndarray) -> int:
    """Dimension of the shapes that a penalty leaves alone."""
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
    """The weight that makes the data most likely, coefficients integrated out (REML).

    Of min ||y - Z c||² + weight c'Rc the marginal likelihood under the prior that the penalty stands for, with the
    noise variance profiled (Wahba 1985; Wood 2011). One eigendecomposition serves every weight.

    Parameters
    ----------
    gram, moment, energy : ndarray (P, P), ndarray (P,), float
        Z'Z, Z'y and y'y of whitened rows, columns that aren't penalised already projected out.
    rows : int
        Number of rows.
    roughness : ndarray, shape (P, P)
        R.
    free : int
        How many columns were projected out.
    null : int, optional
        Dimension of what R leaves alone, where it is known already.
    """
    balance = float(np.trace(gram)) / max(float(np.trace(roughness)), 1e-300)
    floor = 1e-11 * balance
    root = np.linalg.cholesky(gram + floor * roughness + 1e-13 * np.trace(gram) / len(gram) * np.eye(len(gram)))
    inverse = np.linalg.inv(root)
    half = inverse @ roughness @ inverse.T
    bent, turn = np.linalg.eigh((half + half.T) / 2)
    bent = np.clip(bent, 0.0, None)
    # What the penalty leaves alone is a property of it, not of the data: where no data are, every shape looks bent.
    straight = np.arange(bent.size) < (straight_lines(roughness) if null is None else null)
    part = turn.T @ (inverse @ moment)
    freedom_left = max(rows - free - int(straight.sum()), 1)
    weight = np.geomspace(LOWEST, HIGHEST, 73) * balance
    bottom = np.maximum(1.0 + (weight[:, None] - floor) * bent, 1e-12)
    squares = np.maximum(energy - (part**2 / bottom).sum(axis=1), 1e-14 * energy + 1e-300)
    score = -freedom_left * np.log(squares) - np.log(bottom).sum(axis=1) + (~straight).sum() * np.log(weight)
    best = int(np.argmax(score))
    chosen = weight[best]
    if 0 < best < weight.size - 1:  # the top of the parabola through three points
        below, here, above = score[best - 1 : best + 2]
        shift = 0.5 * (below - above) / min(below - 2 * here + above, -1e-12)
        chosen = weight[best] * (weight[1] / weight[0]) ** shift
    bottom = np.maximum(1.0 + (chosen - floor) * bent, 1e-12)
    left = max(energy - float((part**2 / bottom).sum()), 1e-14 * energy)
    kept = float(((1.0 - floor * bent) / bottom).sum())
    return Choice(float(chosen), kept, left / freedom_left)

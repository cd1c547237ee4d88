"""The demand that follows a torque best through G, within bounds: banded least squares, exact, some milliseconds.

With G = B(q)/A(q), both of a few coefficients, torque and demand are written by one sequence v: y = B v, w = A v. Then
least squares with bounds is a quadratic programme whose matrices are banded. It is solved by an interior-point method
(Mehrotra 1992), each step of which is a banded Cholesky factorisation.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import blas, cho_solve_banded, cholesky_banded

BEND = 0.02
"""Weight of the demand's second differences: a demand that jumps from pulse to pulse is nobody's wish."""
RIDGE = 1e-7
ROUNDS = 40
CLOSE = 1e-8


class Banded:
    """A lower triangular Toeplitz matrix with few coefficients, shape (K, K)."""

    def __init__(self, taps: np.ndarray, size: int) -> None:
        self.taps, self.size = np.asarray(taps, float), size
        self.used = [i for i in np.flatnonzero(self.taps) if i < size]

    def __call__(self, v: np.ndarray) -> np.ndarray:
        """The matrix times a column."""
        return np.convolve(self.taps, v)[: self.size]

    def transposed(self, y: np.ndarray) -> np.ndarray:
        """Its transpose times a column."""
        return np.convolve(self.taps, y[::-1])[: self.size][::-1]

    def gram(self, weight: np.ndarray, bands: int) -> np.ndarray:
        """Tᵀ diag(weight) T in LAPACK's lower banded form, shape (bands, K)."""
        out = np.zeros((bands, self.size))
        for i in self.used:
            for j in self.used:
                if i <= j:  # row k of T holds taps[j] at k - j and taps[i] at k - i, which is j - i further on
                    out[j - i, : self.size - j] += self.taps[i] * self.taps[j] * weight[j:]
        return out


def best_demand(
    a: np.ndarray, b: np.ndarray, target_nm: np.ndarray, largest_nm: float, rise_nm: np.ndarray | None = None
) -> np.ndarray:
    """The demand from 0 to `largest_nm` whose torque is closest to a target, N·m, shape (K,).

    `a`, `b`: coefficients of G on the grid of pulses, a[0] = 1. `rise_nm`: largest rise of the demand to each pulse
    from the one before; the first from 0.
    """
    size = target_nm.size
    A, B = Banded(a, size), Banded(b, size)
    bend = Banded(np.convolve(a, [1.0, -2.0, 1.0]), size)
    bands = min(max(len(a) + 2, int(np.ptp(B.used)) + 1 if B.used else 1), size)
    smooth = np.full(size, BEND)
    smooth[:2] = 0.0  # the first pulse may begin anywhere
    P = B.gram(np.ones(size), bands) + bend.gram(smooth, bands) + A.gram(np.full(size, RIDGE), bands)
    q = -B.transposed(target_nm / largest_nm)
    sides = [(A, 1.0, np.ones(size)), (A, -1.0, np.zeros(size))]
    if rise_nm is not None:
        sides.append((Banded(np.convolve(a, [1.0, -1.0]), size), 1.0, rise_nm / largest_nm))
    return np.clip(largest_nm * A(_minimise(P, q, sides, bands)), 0.0, largest_nm)


def _minimise(P: np.ndarray, q: np.ndarray, sides: list[tuple[Banded, float, np.ndarray]], bands: int) -> np.ndarray:
    """argmin ½ vᵀ P v + qᵀ v with sign · (T v) ≤ limit for each of the sides, shape (K,)."""
    limit = np.stack([bound for *_, bound in sides])

    def constrained(v: np.ndarray) -> np.ndarray:
        return np.stack([sign * T(v) for T, sign, _ in sides])

    def back(y: np.ndarray) -> np.ndarray:
        return np.sum([sign * T.transposed(row) for (T, sign, _), row in zip(sides, y, strict=True)], axis=0)

    v = np.asarray(cho_solve_banded((cholesky_banded(P, lower=True), True), -q))
    if np.all(constrained(v) <= limit):
        return v
    slack = np.maximum(limit - constrained(v), 0.1)
    dual = np.full(slack.shape, 0.1)
    for _ in range(ROUNDS):
        gradient = blas.dsbmv(bands - 1, 1.0, P, v, lower=1) + q + back(dual)  # type: ignore
        outside = constrained(v) + slack - limit
        gap = float(np.mean(slack * dual))
        if gap < CLOSE and np.max(np.abs(outside)) < CLOSE and np.max(np.abs(gradient)) < 100 * CLOSE:
            break
        grams = [T.gram(w, bands) for (T, *_), w in zip(sides, dual / slack, strict=True)]
        factor = np.asarray(cholesky_banded(P + np.sum(grams, axis=0), lower=True)), True
        product = slack * dual
        for corrected in (False, True):  # Newton's step that takes `product` off slack times dual
            dv = np.asarray(cho_solve_banded(factor, -gradient - back((dual * outside - product) / slack)))
            ds = -outside - constrained(dv)
            dz = (-product - dual * ds) / slack
            length = min(_longest(slack, ds), _longest(dual, dz))
            if not corrected:
                left = float(np.mean((slack + length * ds) * (dual + length * dz)))
                product = slack * dual + ds * dz - gap * (left / gap) ** 3
        v, slack, dual = v + 0.99 * length * dv, slack + 0.99 * length * ds, dual + 0.99 * length * dz
    return v


def _longest(x: np.ndarray, dx: np.ndarray) -> float:
    """The longest step up to 1/0.99 that keeps x positive."""
    down = dx < 0.0
    return min(1.0 / 0.99, float(np.min(-x[down] / dx[down]))) if np.any(down) else 1.0 / 0.99

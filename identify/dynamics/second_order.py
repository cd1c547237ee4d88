"""Second-order muscle dynamics on the grid of pulses, exact for a held input.

The linear block of the paper in physical terms, T² y'' + 2 ζ T y' + y = w, with w held over each pulse interval.
The matrix exponential gives the state (y, y') at the next pulse. Within an interval y is a smooth curve between the
states at its two ends: exact for a held input, or a cubic if both lags are long. A delay needs no further states: it
shifts the times at which the curve is read.
"""

from __future__ import annotations

import numpy as np

Core = tuple[float, float]
"""T, s, and ζ."""


def step_matrix(time_constant_s: float, damping: float, step_s: float) -> tuple[float, float, float, float]:
    """Transition matrix of x = (y, y') over one step without drive, row by row. `boundary` compiles this function."""
    h = step_s / time_constant_s
    decay = np.exp(-damping * h)
    gap = damping * damping - 1.0
    root = np.sqrt(abs(gap))
    arg = root * h
    if abs(gap) < 1e-10:
        c, s = 1.0, h
    elif gap < 0:
        c, s = np.cos(arg), np.sin(arg) / root
    else:
        c, s = np.cosh(arg), np.sinh(arg) / root
    return (
        decay * (c + damping * s),
        decay * s * time_constant_s,
        -decay * s / time_constant_s,
        decay * (c - damping * s),
    )


CUBIC = (0.0, 1.0)
"""Used in place of T and ζ if no dynamics are given."""


def curve_weights(fraction: np.ndarray, step_s: float, time_constant_s: float, damping: float) -> np.ndarray:
    """Weights of (y0, y0', y1, y1') for the curve between two boundary states, shape (N, 4).

    It is the cubic with the smallest change that makes it exact for a held input. Without the change, a lag of a few
    milliseconds would bend the curve more sharply than a cubic can. `fraction`, (N,), is the place in the step, 0 to 1;
    with T = 0 it is the cubic itself.
    """
    s, t = fraction, 1.0 - fraction
    weights = np.stack([(1.0 + 2.0 * s) * t * t, s * t * t, s * s * (3.0 - 2.0 * s), -s * s * t], axis=1)
    if time_constant_s > 0.0:
        # The three possible motions with a held input: constant, response to a step, response to an initial rate.
        p11, p12, p21, p22 = step_matrix(time_constant_s, damping, step_s)
        last = p12 / step_s, p22
        ends = np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, -step_s * p21 / (1.0 - p11)], [0.0, 1.0, *last]])
        partial = step_matrix(time_constant_s, damping, s * step_s)  # type: ignore
        short = np.stack([np.ones_like(s), (1.0 - partial[0]) / (1.0 - p11), partial[1] / step_s], axis=1)
        weights += (short - weights @ ends.T) @ np.linalg.solve(ends @ ends.T, ends)
    weights[:, 1::2] *= step_s
    return weights


def transition(time_constant_s: float, damping: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact transition of T² y'' + 2 ζ T y' + y = w over one step with w held: Φ, shape (2, 2), and Γ, (2,).

    With x = (y, y'), x[k+1] = Φ x[k] + Γ w[k].
    """
    p11, p12, p21, p22 = step_matrix(time_constant_s, damping, step_s)
    return np.array([[p11, p12], [p21, p22]]), np.array([1.0 - p11, -p21])


def recursion(a: np.ndarray, forced: np.ndarray) -> np.ndarray:
    """y[k] = forced[k] - a[1] y[k-1] - a[2] y[k-2] …, from rest, along the first axis; a[0] = 1.

    This is a lower triangular banded system, which LAPACK solves by this recursion. scipy.signal.lfilter does the same,
    but its import takes 0.3 s, a third of the time of `stimrig fit`. `forced`, shape (K,) or (K, M), is overwritten if
    it is in Fortran order.
    """
    from scipy.linalg import lapack  # here: its import takes as long as a fit, which does not need it

    bands = np.empty((len(a), forced.shape[0]), order="F")
    bands[:] = np.asarray(a, float)[:, None]
    solved, _ = lapack.dtbtrs(  # type: ignore
        bands, forced if forced.ndim == 2 else forced[:, None], uplo="L", overwrite_b=True
    )
    return solved if forced.ndim == 2 else solved[:, 0]

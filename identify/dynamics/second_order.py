"""Second-order muscle dynamics on the grid of pulses, exact for a held input; compiled.

The linear block of the paper in physical terms, T² y'' + 2 ζ T y' + y = w, with w held over each pulse interval.
The matrix exponential gives the state (y, y') at the next pulse. Within an interval y is a smooth curve between the
states at its two ends: exact for a held input, or a cubic if both lags are long. A delay needs no further states: it
shifts the times at which the curve is read.
"""

from __future__ import annotations

import numpy as np
from numba import njit

Core = tuple[float, float]
"""T, s, and ζ."""
CUBIC = (0.0, 1.0)
"""Used in place of T and ζ if no dynamics are given."""
FROM_START = np.zeros(1, np.int64)


@njit(cache=True, nogil=True)
def step_matrix(time_constant_s, damping, step_s):  # pragma: no cover
    """Transition matrix of x = (y, y') over one step without drive, row by row."""
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
    first, last = decay * (c + damping * s), decay * (c - damping * s)
    return first, decay * s * time_constant_s, -decay * s / time_constant_s, last


def transition(time_constant_s: float, damping: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact transition of T² y'' + 2 ζ T y' + y = w over one step with w held: Φ, shape (2, 2), and Γ, (2,).

    With x = (y, y'), x[k+1] = Φ x[k] + Γ w[k].
    """
    phi = np.reshape(step_matrix(time_constant_s, damping, step_s), (2, 2))
    return phi, np.array([1.0 - phi[0, 0], -phi[1, 0]])


@njit(cache=True, nogil=True)
def through(drive, torque, rate, rows, even, varied, begins, initial):  # pragma: no cover
    """Four rows at a time through given transitions: each waits for itself alone, so four take hardly longer than one.

    `torque` and `rate`, (M, K + 1), take the states of the `rows`, (R,), of `drive`, (M, K). `even`, (M, 4), holds each
    row's transition, where it is the same in all intervals; else `varied`, (4, K) and not (4, 0), that of each interval
    for all rows. Each part begins at an interval of `begins`, (B,), the first 0, with a state of `initial`, (M, B, 2).
    """
    size, last = drive.shape[1], rows.size - 1
    for first in range(0, rows.size, 4):
        a, b, c, d = rows[first], rows[min(first + 1, last)], rows[min(first + 2, last)], rows[min(first + 3, last)]
        for part in range(begins.size):
            start, stop = begins[part], begins[part + 1] if part + 1 < begins.size else size
            for row in (a, b, c, d):
                torque[row, start], rate[row, start] = initial[row, part, 0], initial[row, part, 1]
            ya, yb, yc, yd = torque[a, start], torque[b, start], torque[c, start], torque[d, start]
            va, vb, vc, vd = rate[a, start], rate[b, start], rate[c, start], rate[d, start]
            a1, a2, a3, a4 = even[a]
            b1, b2, b3, b4 = even[b]
            c1, c2, c3, c4 = even[c]
            d1, d2, d3, d4 = even[d]
            for k in range(start, stop):
                if varied.shape[1] > 0:
                    a1, a2, a3, a4 = varied[0, k], varied[1, k], varied[2, k], varied[3, k]
                    b1, b2, b3, b4 = a1, a2, a3, a4
                    c1, c2, c3, c4 = a1, a2, a3, a4
                    d1, d2, d3, d4 = a1, a2, a3, a4
                wa, wb, wc, wd = drive[a, k], drive[b, k], drive[c, k], drive[d, k]
                ya, va = wa + a1 * (ya - wa) + a2 * va, a3 * (ya - wa) + a4 * va
                yb, vb = wb + b1 * (yb - wb) + b2 * vb, b3 * (yb - wb) + b4 * vb
                yc, vc = wc + c1 * (yc - wc) + c2 * vc, c3 * (yc - wc) + c4 * vc
                yd, vd = wd + d1 * (yd - wd) + d2 * vd, d3 * (yd - wd) + d4 * vd
                torque[a, k + 1], torque[b, k + 1], torque[c, k + 1], torque[d, k + 1] = ya, yb, yc, yd
                rate[a, k + 1], rate[b, k + 1], rate[c, k + 1], rate[d, k + 1] = va, vb, vc, vd


@njit(cache=True, nogil=True)
def held_states(drive, even, begins, initial):  # pragma: no cover
    """Boundary states, each (M, K + 1), of rows of held drives; `even` (M, 4) holds each row's transition."""
    rows, size = drive.shape
    torque, rate = np.empty((rows, size + 1)), np.empty((rows, size + 1))
    through(drive, torque, rate, np.arange(rows), even, np.empty((4, 0)), begins, initial)
    return torque, rate


def boundary_states(
    core: Core, step_s: float, drive_nm: np.ndarray, initial: tuple[float, float] = (0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Torque and its rate at the ends of the pulse intervals, each of shape (M, K + 1), from a state in `initial`.

    `drive_nm`, shape (M, K), is held in each interval.
    """
    even = np.tile(step_matrix(*core, step_s), (len(drive_nm), 1))
    start = np.tile(np.asarray(initial, float), (len(drive_nm), 1, 1))
    return held_states(np.ascontiguousarray(drive_nm, float), even, FROM_START, start)


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
        partial = step_matrix.py_func(time_constant_s, damping, s * step_s)  # type: ignore
        short = np.stack([np.ones_like(s), (1.0 - partial[0]) / (1.0 - p11), partial[1] / step_s], axis=1)
        weights += (short - weights @ ends.T) @ np.linalg.solve(ends @ ends.T, ends)
    weights[:, 1::2] *= step_s
    return weights


@njit(cache=True, nogil=True)
def read_at(torque, rate, interval, place, offset, weights):  # pragma: no cover
    """The curve through boundary states at samples, shape (N,); constant before the first and after the last state.

    `interval` and `place`, (N,), say in which interval each sample is, at which of U places; `offset`, (U,), how many
    intervals from there its curve is read, with `weights`, (U, 4), of `curve_weights`.
    """
    out = np.empty(interval.size)
    last = torque.size - 1
    for n in range(interval.size):
        k, w = interval[n] + offset[place[n]], weights[place[n]]
        if k < 0:
            out[n] = torque[0]
        elif k >= last:
            out[n] = torque[last]
        else:
            out[n] = w[0] * torque[k] + w[1] * rate[k] + w[2] * torque[k + 1] + w[3] * rate[k + 1]
    return out


@njit(cache=True, nogil=True)
def mean_weights(four, offset, place, interval, count):  # pragma: no cover
    """The earliest boundary's offset, and weights of (y, y') at the boundaries in each interval's mean, (K, B, 2).

    `four`, (U, 4), and `offset`, (U,), are as in `read_at`; `place` and `interval`, (N,), are those of each sample, and
    `count`, (K,), the samples in each interval.
    """
    low, high = offset[0], offset[0]
    for u in range(offset.size):
        low, high = min(low, offset[u]), max(high, offset[u])
    weights = np.zeros((count.size, high - low + 2, 2))
    for n in range(place.size):
        u, k = place[n], interval[n]
        b, r = offset[u] - low, 1.0 / count[k]
        weights[k, b, 0] += r * four[u, 0]
        weights[k, b, 1] += r * four[u, 1]
        weights[k, b + 1, 0] += r * four[u, 2]
        weights[k, b + 1, 1] += r * four[u, 3]
    return low, weights


@njit(cache=True, nogil=True)
def read_means(torque, rate, first, weights, states, out, rows):  # pragma: no cover
    """Means over intervals from boundary states; constant before the first and after the last state.

    Row `rows[m]` of `out`, (., K), becomes that of row `states[m]` of the states. `first` and `weights` are as
    `mean_weights` gives them; a single row of weights holds for all intervals.
    """
    size = torque.shape[1] - 1
    even = weights.shape[0] == 1 and size > 1
    for m in range(rows.size):
        mean, y, v = out[rows[m]], torque[states[m]], rate[states[m]]
        mean[:] = 0.0
        for b in range(weights.shape[1]):
            at = first + b
            low, high = min(max(0, -at), size), max(min(size, size + 1 - at), 0)
            if even:
                w0, w1 = weights[0, b, 0], weights[0, b, 1]
                for k in range(low, high):
                    mean[k] += w0 * y[k + at] + w1 * v[k + at]
            else:
                for k in range(low, high):
                    mean[k] += weights[k, b, 0] * y[k + at] + weights[k, b, 1] * v[k + at]
            for k in range(low):
                mean[k] += weights[0 if even else k, b, 0] * y[0]
            for k in range(high, size):
                mean[k] += weights[0 if even else k, b, 0] * y[size]
    return out


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

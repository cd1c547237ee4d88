"""Noise with a narrow band: white plus slow plus a stochastic oscillator, by an exact Kalman filter; compiled.

Tremor does not depend on the stimulation, and its frequency and size vary. As part of the noise it needs only three
parameters, and other effects can be compared beside it.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def _system(ar1, slow, turn, keep, band):  # pragma: no cover
    """Transition of (slow, cos, sin) over a step, the stationary covariance, and what each step adds to it."""
    c, s = keep * np.cos(turn), keep * np.sin(turn)
    f = np.zeros((3, 3))
    f[0, 0] = ar1
    f[1, 1], f[1, 2], f[2, 1], f[2, 2] = c, -s, s, c
    p = np.zeros((3, 3))
    p[0, 0], p[1, 1], p[2, 2] = slow, band, band
    q = np.zeros(3)
    q[0], q[1], q[2] = slow * (1 - ar1 * ar1), band * (1 - keep * keep), band * (1 - keep * keep)
    return f, p, q


@njit(cache=True, nogil=True)
def _ahead(f, p, q):  # pragma: no cover
    """Covariance a step later."""
    fresh = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += f[i, a] * p[a, b] * f[j, b]
            fresh[i, j] = total
        fresh[i, i] += q[i]
    return fresh


@njit(cache=True, nogil=True)
def _gains(length, ar1, slow, turn, keep, band):  # pragma: no cover
    """Kalman gains of (slow, cos, sin) and innovation variances for a stretch of `length` from the stationary state."""
    f, p, q = _system(ar1, slow, turn, keep, band)
    white = max(1.0 - slow - band, 1e-9)
    gains = np.empty((length, 3))
    variances = np.empty(length)
    settled = False
    for k in range(length):
        if settled:
            gains[k] = gains[k - 1]
            variances[k] = variances[k - 1]
            continue
        h = np.empty(3)
        for i in range(3):
            h[i] = p[i, 0] + p[i, 1]
        v = h[0] + h[1] + white
        variances[k] = v
        for i in range(3):
            gains[k, i] = h[i] / v
        for i in range(3):
            for j in range(3):
                p[i, j] -= gains[k, i] * h[j]
        p = _ahead(f, p, q)
        settled = k > 30 and abs(variances[k] - variances[k - 1]) < 1e-11
    return gains, variances


@njit(cache=True, nogil=True)
def whiten_band(rows, start, stop, ar1, slow, turn, keep, band):  # pragma: no cover
    """As `whiten_rows`, with an oscillator: `turn` is its angle per step, `keep` its decay, `band` its share."""
    total, longest = 0, 0
    for i in range(start.size):
        total += stop[i] - start[i]
        longest = max(longest, stop[i] - start[i])
    gains, variances = _gains(longest, ar1, slow, turn, keep, band)
    c, s = keep * np.cos(turn), keep * np.sin(turn)
    white = np.empty((rows.shape[0], total))
    logdet = 0.0
    for i in range(start.size):
        for k in range(stop[i] - start[i]):
            logdet += 0.5 * np.log(variances[k])
    for m in range(rows.shape[0]):
        f = 0
        for i in range(start.size):
            x, u, v = 0.0, 0.0, 0.0
            for k in range(stop[i] - start[i]):
                e = rows[m, start[i] + k] - x - u
                white[m, f] = e / np.sqrt(variances[k])
                x += gains[k, 0] * e
                u += gains[k, 1] * e
                v += gains[k, 2] * e
                x, u, v = ar1 * x, c * u - s * v, s * u + c * v
                f += 1
    return white, logdet


@njit(cache=True, nogil=True)
def _squares(row, start, stop, x):  # pragma: no cover
    """Sum of squared innovations, count and half the log determinant.

    At x = (log(1 - ar1), slow share of the rest, turn, log(1 - keep), band).
    """
    slow = x[1] * (1.0 - x[4])
    white, logdet = whiten_band(row, start, stop, 1.0 - np.exp(x[0]), slow, x[2], 1.0 - np.exp(x[3]), x[4])
    squares = 0.0
    for k in range(white.shape[1]):
        squares += white[0, k] * white[0, k]
    return squares, white.shape[1], logdet


@njit(cache=True, nogil=True)
def _cost(row, start, stop, x):  # pragma: no cover
    """Minus the profiled log-likelihood, up to a constant."""
    squares, size, logdet = _squares(row, start, stop, x)
    return 0.5 * size * np.log(max(squares / size, 1e-24)) + logdet


@njit(cache=True, nogil=True)
def profile_band(row, start, stop, x, lower, upper, step, least):  # pragma: no cover
    """Coordinate search from x, halving its steps to `least`; returns x, sd and log-likelihood."""
    rows = row.reshape(1, row.size)
    best = _cost(rows, start, stop, x)
    scale = 1.0
    while scale > least:
        moved = False
        for i in range(x.size):
            for sign in (1.0, -1.0):
                trial = x.copy()
                trial[i] = min(max(x[i] + sign * scale * step[i], lower[i]), upper[i])
                if trial[i] == x[i]:
                    continue
                value = _cost(rows, start, stop, trial)
                if value < best - 1e-7:
                    best, moved = value, True
                    x = trial
                    break
        if not moved:
            scale *= 0.5
    squares, total, _ = _squares(rows, start, stop, x)
    sd = np.sqrt(max(squares / total, 1e-24))
    return x, sd, -best - 0.5 * total * (np.log(2 * np.pi) + 1.0)


@njit(cache=True, nogil=True)
def smooth_band(row, start, stop, ar1, slow, turn, keep, band):  # pragma: no cover
    """The oscillator's part of a residual, given all of it (fixed-interval smoother); zero outside the stretches."""
    out = np.zeros(row.size)
    for i in range(start.size):
        f, p, q = _system(ar1, slow, turn, keep, band)
        length = stop[i] - start[i]
        gains, variances = _gains(length, ar1, slow, turn, keep, band)
        errors = np.empty(length)
        state = np.zeros((length, 3))
        x = np.zeros(3)
        for k in range(length):
            state[k] = x
            errors[k] = row[start[i] + k] - x[0] - x[1]
            y = x + gains[k] * errors[k]
            for a in range(3):
                x[a] = f[a, 0] * y[0] + f[a, 1] * y[1] + f[a, 2] * y[2]
        # Backward pass on the adjoint r: x_hat = x + P r, with P h = gain * variance; only the oscillator is wanted.
        r = np.zeros(3)
        covariances = np.zeros((length, 3, 3))
        for k in range(length):
            covariances[k] = p
            kalman = np.zeros((3, 3))
            for a in range(3):
                for b in range(3):
                    kalman[a, b] = p[a, b] - gains[k, a] * (p[0, b] + p[1, b])
            p = _ahead(f, kalman, q)
        for k in range(length - 1, -1, -1):
            back = np.zeros(3)
            for a in range(3):
                back[a] = f[0, a] * r[0] + f[1, a] * r[1] + f[2, a] * r[2]
            weight = gains[k, 0] * back[0] + gains[k, 1] * back[1] + gains[k, 2] * back[2]
            h = errors[k] / variances[k] - weight
            r[0], r[1], r[2] = back[0] + h, back[1] + h, back[2]
            out[start[i] + k] = (
                state[k, 1] + covariances[k, 1, 0] * r[0] + covariances[k, 1, 1] * r[1] + covariances[k, 1, 2] * r[2]
            )
    return out

"""Means of an interval's samples, read off the boundary states, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def mean_weights(fraction, interval, count, shift, step_s):  # pragma: no cover
    """Weights of the boundary states in each interval's mean of samples read `shift` steps late.

    Parameters
    ----------
    fraction, interval : ndarray, shape (N,)
        Place of each sample in its interval, 0 to 1, and which that is.
    count : ndarray of int, shape (K,)
        Samples in each interval.
    shift, step_s : float
        Lag, in steps, and the length of a step, s.

    Returns
    -------
    first : int
        Offset of the earliest boundary.
    weights : ndarray, shape (K, B, 2)
        For (y, y').
    """
    low, high = 1 << 30, -(1 << 30)
    for n in range(fraction.size):
        o = int(np.floor(fraction[n] - shift))
        low, high = min(low, o), max(high, o)
    weights = np.zeros((count.size, high - low + 2, 2))
    for n in range(fraction.size):
        at = fraction[n] - shift
        o = int(np.floor(at))
        s = at - o
        k, b = interval[n], o - low
        r, t = 1.0 / count[k], 1.0 - s
        weights[k, b, 0] += r * (1 + 2 * s) * t * t
        weights[k, b, 1] += r * step_s * s * t * t
        weights[k, b + 1, 0] += r * s * s * (3 - 2 * s)
        weights[k, b + 1, 1] -= r * step_s * s * s * t
    return low, weights


@njit(cache=True, nogil=True)
def read_means(torque, rate, first, weights):  # pragma: no cover
    """Means over intervals, shape (M, K), from boundary states of shape (M, K + 1); before and after they stand.

    Parameters
    ----------
    torque, rate : ndarray, shape (M, K + 1)
        Boundary states.
    first : int
        Offset of the earliest boundary.
    weights : ndarray, shape (K, B, 2) or (1, B, 2)
        As `mean_weights` gives them; one row stands for all intervals.
    """
    rows, size = torque.shape[0], torque.shape[1] - 1
    even = weights.shape[0] == 1 and size > 1
    out = np.zeros((rows, size))
    for m in range(rows):
        for b in range(weights.shape[1]):
            at = first + b
            low, high = min(max(0, -at), size), max(min(size, size + 1 - at), 0)
            if even:
                w0, w1 = weights[0, b, 0], weights[0, b, 1]
                for k in range(low, high):
                    out[m, k] += w0 * torque[m, k + at] + w1 * rate[m, k + at]
            else:
                for k in range(low, high):
                    out[m, k] += weights[k, b, 0] * torque[m, k + at] + weights[k, b, 1] * rate[m, k + at]
            for k in range(low):
                out[m, k] += weights[0 if even else k, b, 0] * torque[m, 0]
            for k in range(high, size):
                out[m, k] += weights[0 if even else k, b, 0] * torque[m, size]
    return out

"""Weights of boundary states in the mean of an interval's samples, compiled."""

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

"""Means of an interval's samples, computed from the boundary states; compiled."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def mean_weights(four, offset, place, interval, count):  # pragma: no cover
    """Weights of the boundary states in each interval's mean of its samples.

    Parameters
    ----------
    four : ndarray, shape (U, 4)
        Weights of (y, y') before and after each place in an interval at which samples were taken.
    offset : ndarray of int, shape (U,)
        Number of intervals from the sample's own to the one in which the curve is read.
    place, interval : ndarray of int, shape (N,)
        Place and interval of each sample.
    count : ndarray of int, shape (K,)
        Samples in each interval.

    Returns
    -------
    first : int
        Offset of the earliest boundary.
    weights : ndarray, shape (K, B, 2)
        For (y, y').
    """
    low = offset.min()
    weights = np.zeros((count.size, offset.max() - low + 2, 2))
    for n in range(place.size):
        u, k = place[n], interval[n]
        b, r = offset[u] - low, 1.0 / count[k]
        weights[k, b, 0] += r * four[u, 0]
        weights[k, b, 1] += r * four[u, 1]
        weights[k, b + 1, 0] += r * four[u, 2]
        weights[k, b + 1, 1] += r * four[u, 3]
    return low, weights


@njit(cache=True, nogil=True)
def read_means(torque, rate, first, weights):  # pragma: no cover
    """Means over intervals, shape (M, K), from boundary states; constant before the first and after the last state.

    Parameters
    ----------
    torque, rate : ndarray, shape (M, K + 1)
        Boundary states.
    first : int
        Offset of the earliest boundary.
    weights : ndarray, shape (K, B, 2) or (1, B, 2)
        As `mean_weights` gives them; a single row holds for all intervals.
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

"""Weights of boundary states in the mean of an interval's samples, compiled."""

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
        Steps from the sample's interval to the one in which its curve is read.
    place, interval : ndarray of int, shape (N,)
        Of each sample.
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

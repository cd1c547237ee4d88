"""Products of a few long rows, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, fastmath=True)
def gram(rows):  # pragma: no cover
    """rows @ rows.T for a few long rows, on one core: the threads of a library cost more time than they save here."""
    count, size = rows.shape
    out = np.empty((count, count))
    for i in range(count):
        for j in range(i + 1):
            total = 0.0
            for k in range(size):
                total += rows[i, k] * rows[j, k]
            out[i, j] = total
            out[j, i] = total
    return out

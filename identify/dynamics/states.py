"""States of second-order dynamics at the ends of the pulse intervals, the curve between them, its means; compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

from stimrig.identify.dynamics import second_order

step_matrix = njit(cache=True, nogil=True)(second_order.step_matrix)


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


FROM_START = np.zeros(1, np.int64)


def boundary_states(
    time_constant_s: float,
    damping: float,
    step_s: float,
    drive_nm: np.ndarray,
    initial: tuple[float, float] = (0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """Torque and its rate at the ends of the pulse intervals, each of shape (K + 1,) or (K + 1, M).

    `drive_nm`, shape (K,) or (K, M), is held in each interval; columns are filtered separately, from torque and rate in
    `initial`. The rest is as in `transition`.
    """
    drive = np.ascontiguousarray(np.atleast_2d(drive_nm.T), float)
    even = np.tile(second_order.step_matrix(time_constant_s, damping, step_s), (len(drive), 1))
    start = np.tile(np.asarray(initial, float), (len(drive), 1, 1))
    torque, rate = held_states(drive, even, FROM_START, start)
    return (torque[0], rate[0]) if drive_nm.ndim == 1 else (torque.T, rate.T)


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
def read_means(torque, rate, first, weights):  # pragma: no cover
    """Means over intervals, shape (M, K), from boundary states; constant before the first and after the last state.

    `first` and `weights` are as `mean_weights` gives them; a single row of weights holds for all intervals.
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

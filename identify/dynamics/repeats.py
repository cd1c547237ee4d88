"""Parts of a record that had the same input: the same pulse widths in the same order, wherever they stand.

Widths alone decide, to a microsecond, and a pulse may come one sooner or later. A muscle still shows what came before:
the first 1.5 s of a part that repeats are the approach to the same state and do not count, nor does rest.
"""

from __future__ import annotations

import numpy as np
from numba import njit

SAME_US = 1.0 + 1e-6
"""Widths that differ by less are the same, but for rounding to whole µs."""
LARGEST_DIFFERENCE = 0.05
"""Mean difference of the widths of two repeats, as a share of the largest, at most."""
APART = 10
"""Alignments of the same two parts that differ by fewer intervals compete: only the best one counts."""
MAX_ROWS = 12_000
"""Only so many of the last intervals are looked at (5 min): time grows with the square."""
MAX_RUNS = 20_000


def find_repeats(width_us: np.ndarray, known: np.ndarray, memory: int) -> np.ndarray:
    """A number for each interval, the same for those with the same input, shape (K,); -1 where it did not repeat.

    `known` says in which intervals stimulation and torque are known, and follow on the one before; after `memory`
    intervals the muscle has forgotten.
    """
    first = max(width_us.size - MAX_ROWS, 0)
    width = np.ascontiguousarray(width_us[first:])
    limit = LARGEST_DIFFERENCE * float(width.max(initial=0.0))
    runs, size = equal_runs(width, known[first:], memory, limit, np.empty((MAX_RUNS, 4)))
    worked = np.convolve(width > 0.0, np.ones(memory))[: width.size] > 0.5
    rows = np.arange(width.size)
    label, touched = rows.copy(), np.zeros(width.size, bool)
    for start, stop, lag in _best(runs[:size], memory):
        # Parts that follow one another, each the repeat of the last: one after the other.
        for begin in range(start + memory, stop, lag):
            repeated = rows[begin : min(begin + lag, stop)]
            repeated = repeated[worked[repeated]]
            touched[repeated] = touched[repeated + lag] = True
            low, high = np.sort([label[repeated], label[repeated + lag]], axis=0)
            far = high - low >= APART
            same = rows.copy()
            same[high[far]] = low[far]
            label = same[same[label]]
    return np.r_[np.full(first, -1), np.where(touched & ~_crowded(label, touched), label, -1)]


def _crowded(label: np.ndarray, touched: np.ndarray) -> np.ndarray:
    """bool, shape (K,): intervals of a group that has two neighbours, which no alignment gives."""
    order = np.lexsort((np.arange(label.size), label))
    order = order[touched[order]]
    near = (np.diff(label[order]) == 0) & (np.diff(order) < APART)
    return np.isin(label, label[order][1:][near])


def _best(runs: np.ndarray, memory: int) -> list[tuple[int, int, int]]:
    """Start, stop and lag of the runs that count: of several alignments of the same two parts the closest."""
    chosen: list[tuple[int, int, int]] = []
    order = np.lexsort((runs[:, 0] - runs[:, 1], runs[:, 3]))
    for start, stop, lag in runs[order, :3].astype(np.int64).tolist():
        neighbours = (other for other in chosen if abs(other[2] - lag) < APART)
        if not any(start < other[1] - memory and other[0] + memory < stop for other in neighbours):
            chosen.append((start, stop, lag))
    return chosen


@njit(cache=True, nogil=True)
def _same(width, known, i, j):  # pragma: no cover
    if not (known[i] and known[j]):
        return False
    current = width[i]
    if abs(current - width[j]) <= SAME_US or abs(current - width[j - 1]) <= SAME_US:
        return True
    return j + 1 < width.size and abs(current - width[j + 1]) <= SAME_US


@njit(cache=True, nogil=True)
def equal_runs(width, known, memory, limit, table):  # pragma: no cover
    """Start, stop, lag and mean difference of every run of equal widths of at least twice the memory; their number.

    A run that is level throughout repeats nothing. A window is looked at from its end, so that a difference there
    leaves all of it out, and what is level in both places is passed over in one step.
    """
    size, count, min_size = width.size, 0, 2 * memory
    begin, end = np.arange(size), np.arange(size) + 1
    for i in range(1, size):
        if known[i] and known[i - 1] and width[i] == width[i - 1]:
            begin[i] = begin[i - 1]
    for i in range(size - 2, -1, -1):
        if begin[i + 1] == begin[i]:
            end[i] = end[i + 1]
    for lag in range(memory, size - min_size):
        start = 0
        while start + min_size <= size - lag:
            i = start + min_size - 1
            while i >= start and _same(width, known, i, i + lag):
                level = abs(width[i] - width[i + lag]) <= SAME_US
                i = (max(begin[i], begin[i + lag] - lag) if level else i) - 1
            if i >= start:
                start = i + 1
                continue
            stop = start + min_size
            while stop < size - lag and _same(width, known, stop, stop + lag):
                level = abs(width[stop] - width[stop + lag]) <= SAME_US
                stop = min(end[stop], end[stop + lag] - lag) if level else stop + 1
            if begin[stop - 1] > start and count < table.shape[0]:
                apart, low, high = 0.0, width[start], width[start]
                for i in range(start, stop):
                    apart += abs(width[i] - width[i + lag])
                    low, high = min(low, width[i]), max(high, width[i])
                if high - low > 2.0 * SAME_US and apart <= limit * (stop - start):
                    table[count, 0], table[count, 1], table[count, 2] = start, stop, lag
                    table[count, 3] = apart / (stop - start)
                    count += 1
            start = stop + 1
    return table, count

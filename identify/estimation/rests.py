"""Where the rests of a record put its zero. Without them zero and plateau trade where slow noise makes levels cheap."""

from __future__ import annotations

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects.base import IDLE_SHARE

RELAXED_S = 1.0
"""So long after its last pulse a muscle has relaxed; where no rest is twice as long, half of the longest is taken."""
SLOW_S = 0.2
"""Time constant of a slow muscle: what it may still pull that long after its last pulse widens the zero's sd."""
LEAST_SHARE = 0.05
"""The zero is not taken as better known than this share of the torque's range: a residual state may hold it up."""
WANDERS = 0.3
"""Share of a model's error from which the scatter of its means at rest counts as a zero that wanders."""
SHORT = 8
"""Rests of no more intervals say nothing of the noise."""


def rest_levels(grid: Grid, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Torque at rest in each part of a record, and how far the part's zero may be from it, N·m.

    The median over the relaxed rows, and their robust scatter: of a zero that wanders, its spread. A part without a
    rest has its zero somewhere in the range of its torque. Of a part that is held out as a whole nothing but its rests
    is looked at; without them it has the zero of the others.
    """
    for strongest_us in (0.0, IDLE_SHARE * float(np.max(grid.pulse_width_us))):
        since_s = grid.step_s * since_pulse(grid, strongest_us)
        if np.max(since_s[rows]) >= 2.0 * RELAXED_S:
            break
    levels = [_level(grid.torque_nm, since_s, rows & (grid.part == part)) for part in range(grid.begins.size)]
    known = next(pair for pair in levels if pair is not None)
    level_nm, sd_nm = np.array([pair or known for pair in levels]).T
    for part in np.setdiff1d(grid.part, grid.part[grid.fitted]):
        at_rest = grid.comparable & (grid.part == part) & (since_s >= RELAXED_S)
        if at_rest.any():
            level_nm[part] = np.median(grid.torque_nm[at_rest])
    return level_nm, sd_nm


def _level(torque_nm: np.ndarray, since_s: np.ndarray, rows: np.ndarray) -> tuple[float, float] | None:
    if not rows.any():
        return None
    relaxed_s = min(RELAXED_S, 0.5 * float(since_s[rows].max()))
    own_nm = torque_nm[rows & (since_s >= relaxed_s)]
    level_nm = float(np.median(own_nm))
    low_nm, high_nm = np.percentile(torque_nm[rows], (0.5, 99.5))
    scatter_nm = 1.4826 * float(np.median(np.abs(own_nm - level_nm)))
    share = LEAST_SHARE + np.exp(-relaxed_s / SLOW_S)
    return level_nm, max(float(np.hypot(scatter_nm, share * (high_nm - low_nm))), 1e-9)


def relaxed(grid: Grid, after_s: float, strongest_us: float = 0.0) -> np.ndarray:
    """bool, shape (K,): intervals that begin so long, s, after the last pulse that is stronger."""
    return grid.step_s * since_pulse(grid, strongest_us) >= after_s


def since_pulse(grid: Grid, strongest_us: float = 0.0) -> np.ndarray:
    """Intervals without a stronger pulse up to each, itself included; anew where a part or a known state begins."""
    at = np.arange(grid.size)
    last = np.where(grid.pulse_width_us > strongest_us, at, -1)
    last[grid.starts] = np.maximum(last[grid.starts], grid.starts - 1)
    return at - np.maximum.accumulate(last)


def scatter_at_rest(
    grid: Grid, rests: np.ndarray, values_nm: np.ndarray, decays_s: tuple[float, ...] = ()
) -> tuple[float, int]:
    """Variance of some values in the rests, (N·m)², and from how many free rows; 0 from none.

    It is that about a straight line in each rest, and about decays of some time constants.
    """
    squares, free = 0.0, 0
    for rest in grid.stretches(rests):
        if rest.stop - rest.start > SHORT:
            time_s, values = grid.time_s[rest] - grid.time_s[rest.start], values_nm[rest]
            shapes = [np.ones(time_s.size), time_s, *(np.exp(-time_s / decay_s) for decay_s in decays_s)]
            axes = np.linalg.qr(np.stack(shapes, axis=1))[0]
            squares += float(np.sum((values - axes @ (axes.T @ values)) ** 2))
            free += time_s.size - len(shapes)
    return (squares / free if free else 0.0), free


def wandering_zero_nm(grid: Grid, rows: np.ndarray, residual_nm: np.ndarray) -> float:
    """Return how far the zero moves from rest to rest, N·m: the scatter of a residual's means there.

    0 with fewer than two rests, and where it is less than `WANDERS` of the error on those rows.
    """
    rests = [rest for rest in grid.stretches(rows & relaxed(grid, RELAXED_S)) if rest.stop - rest.start > SHORT]
    scatter_nm = np.sqrt(np.mean([np.mean(residual_nm[rest]) ** 2 for rest in rests])) if len(rests) > 1 else 0.0
    return float(scatter_nm) if scatter_nm > WANDERS * np.sqrt(np.mean(residual_nm[rows] ** 2)) else 0.0

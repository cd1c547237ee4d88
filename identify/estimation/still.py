"""The rows of a moving joint in which it is held at one angle, and the angle at which the curve holds."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid

STILL_RAD_S = 0.05
"""A joint that moves more slowly is held still."""
ONE_ANGLE_RAD = 0.09
"""Angles that differ from the middle by less are one: 5 degrees, within which the active torque hardly changes."""
LEAST_S = 3.0
"""Stimulation at one angle from which a first curve can be found there."""
LEAST_WIDTHS = 5
WIDEST_SHARE = 0.9
"""The widest pulse at this angle is at least this share of the widest one anywhere."""


def still_rows(grid: Grid, rows: np.ndarray) -> np.ndarray:
    """Select the rows in which the joint is held at the angle with most stimulation, shape (K,).

    Where the joint never moved, where there is no angle, or where too little was stimulated at any one angle: all.
    """
    if grid.angle_rad is None or grid.velocity_rad_s is None or not moves(grid, rows):
        return rows
    still = rows & (np.abs(grid.velocity_rad_s) < STILL_RAD_S)
    if not still.any():
        return rows
    middle_rad = _middle(grid.angle_rad, still, grid.pulse_width_us)
    at_one_angle = still & (np.abs(grid.angle_rad - middle_rad) < ONE_ANGLE_RAD)
    widths_us = grid.pulse_width_us[at_one_angle & (grid.pulse_width_us > 0)]
    enough = (
        widths_us.size * grid.step_s >= LEAST_S
        and np.unique(widths_us).size >= LEAST_WIDTHS
        and widths_us.max() >= WIDEST_SHARE * grid.pulse_width_us[rows].max()
    )
    return at_one_angle if enough else rows


def moves(grid: Grid, rows: np.ndarray) -> bool:
    """Return True if the joint is at more than one angle in the given rows."""
    return grid.angle_rad is not None and bool(np.ptp(grid.angle_rad[rows]) > 2 * ONE_ANGLE_RAD)


def joint_of(grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    """Fields of a `Setup`: the reference angle, and the range of the fitted angles; none without an angle.

    The reference is the angle at which most was stimulated while the joint was still, else the median while stimulated:
    it does not depend on where the record begins.
    """
    if grid.angle_rad is None or grid.velocity_rad_s is None:
        return {}
    still = rows & (np.abs(grid.velocity_rad_s) < STILL_RAD_S) & (grid.pulse_width_us > 0)
    stimulated = rows & (grid.pulse_width_us > 0)
    if still.any():
        reference = _middle(grid.angle_rad, still, grid.pulse_width_us)
    else:
        reference = float(np.median(grid.angle_rad[stimulated if stimulated.any() else rows]))
    return {
        "reference_rad": reference,
        "angle_range_rad": (float(grid.angle_rad[rows].min()), float(grid.angle_rad[rows].max())),
    }


def _middle(angle_rad: np.ndarray, still: np.ndarray, width_us: np.ndarray) -> float:
    """The angle around which most stimulated rows lie, rad: the median of those in the fullest window."""
    at = np.sort(angle_rad[still & (width_us > 0)])
    if not at.size:
        at = np.sort(angle_rad[still])
    ends = np.searchsorted(at, at + 2 * ONE_ANGLE_RAD, side="right")
    first = int(np.argmax(ends - np.arange(at.size)))
    return float(np.median(at[first : ends[first]]))

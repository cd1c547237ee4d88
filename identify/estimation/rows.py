"""Which rows of a record are fitted; of a moving joint, those at one angle to begin with, and the angle of f."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stimrig.identify.dynamics.pulse_grid import Grid
from stimrig.identify.errors import BadRequest, NotIdentifiable
from stimrig.identify.records.record import HELD_OUT

LEAST_ROWS = 8
STILL_RAD_S = 0.05
"""A joint that moves more slowly is held still."""
ONE_ANGLE_RAD = 0.09
"""Angles that differ from the middle by less are one: 5 degrees, within which the active torque hardly changes."""
LEAST_S = 3.0
"""Stimulation at one angle from which a first curve can be found there."""
LEAST_WIDTHS = 5
WIDEST_SHARE = 0.9
"""The widest pulse at this angle is at least this share of the widest one anywhere."""


def rows_of(grid: Grid, names: Sequence[str]) -> np.ndarray:
    """bool, shape (K,): intervals of segments with these names."""
    wanted = np.array([name in names for name in grid.record.segment_names])
    return wanted[grid.segment]


def fitted_rows(grid: Grid, fit_on: Sequence[str] | None) -> np.ndarray:
    """Rows to fit: those of the named segments and the rests, which determine the baseline; never held-out rows.

    Raises
    ------
    BadRequest
        A named segment is not in the record, or is the held-out one.
    NotIdentifiable
        Fewer than eight pulse intervals are left to fit.
    """
    if fit_on is not None:
        check_segments(grid, fit_on)
        rows = grid.fitted & rows_of(grid, (*fit_on, "rest"))
    else:
        rows = grid.fitted
    refuse_few(rows)
    return rows


def refuse_few(rows: np.ndarray) -> None:
    """Refuse too few rows to fit.

    Raises
    ------
    NotIdentifiable
        With their number.
    """
    if rows.sum() < LEAST_ROWS:
        raise NotIdentifiable(
            f"only {int(rows.sum())} pulse intervals may be fitted", fix="Give rows of segments other than `validate`."
        )


def check_segments(grid: Grid, names: Sequence[str]) -> None:
    """Refuse names of segments that the record does not have, and the held-out one.

    Raises
    ------
    BadRequest
        With the names that can be used.
    """
    there = tuple(dict.fromkeys(grid.record.segment_names))
    for name in names:
        if name == HELD_OUT:
            raise BadRequest("rows of `validate` are never fitted", place="fit_on", fix="Name other segments.")
        if name not in there:
            raise BadRequest(f"no segment {name!r} in the record", place="fit_on", fix=f"It has: {', '.join(there)}.")


def still_rows(grid: Grid, rows: np.ndarray) -> np.ndarray:
    """Of some rows, those in which the joint is held at the angle with most stimulation, shape (K,).

    Where the joint never moved, where there is no angle, or where too little was stimulated at any one angle: all.
    """
    if grid.angle_rad is None or not moves(grid, rows):
        return rows
    own = np.zeros(grid.size, bool)
    still = rows & (np.abs(_velocity(grid)) < STILL_RAD_S)
    if still.any():
        own = still & (np.abs(grid.angle_rad - _middle(grid.angle_rad, still, grid.pulse_width_us)) < ONE_ANGLE_RAD)
    widths_us = grid.pulse_width_us[own & (grid.pulse_width_us > 0)]
    enough = (
        widths_us.size * grid.step_s >= LEAST_S
        and np.unique(widths_us).size >= LEAST_WIDTHS
        and widths_us.max() >= WIDEST_SHARE * grid.pulse_width_us[rows].max()
    )
    return own if enough else rows


def moves(grid: Grid, rows: np.ndarray) -> bool:
    """Whether the joint is at more than one angle in some rows."""
    return grid.angle_rad is not None and bool(np.ptp(grid.angle_rad[rows]) > 2 * ONE_ANGLE_RAD)


def joint_of(grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    """Fields of a `Setup`: the reference angle, and the range of the fitted angles; none without an angle.

    The reference is the angle at which most was stimulated while the joint was still, else the median while stimulated:
    it does not depend on where the record begins.
    """
    if grid.angle_rad is None:
        return {}
    still = rows & (np.abs(_velocity(grid)) < STILL_RAD_S) & (grid.pulse_width_us > 0)
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


def _velocity(grid: Grid) -> np.ndarray:
    assert grid.angle_rad is not None
    if grid.velocity_rad_s is not None:
        return np.nan_to_num(grid.velocity_rad_s)
    return np.gradient(np.nan_to_num(grid.angle_rad), grid.step_s)

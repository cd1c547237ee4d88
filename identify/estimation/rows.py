"""Which rows of a record are fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from identify.dynamics.pulse_grid import Grid
from identify.errors import BadRequest, NotIdentifiable
from identify.records.record import HELD_OUT


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
    if rows.sum() < 8:
        raise NotIdentifiable(
            f"only {int(rows.sum())} pulse intervals may be fitted", fix="Give rows of segments other than `validate`."
        )
    return rows


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

"""What of a record is not counted, since it is not known what was felt then."""

from __future__ import annotations

import numpy as np

from identify.dynamics.pulse_grid import Grid
from identify.errors import BadRecord

TOLD_S = 5e-3
"""Pulses as late as this are counted in the sentence: a fifth of an interval, more than any healthy host's jitter."""
LEAST = 8
"""Intervals without which nothing can be said."""


def left_out(grid: Grid) -> str:
    """How much is left out and why, in one sentence; empty where no pulse was late or lost and nothing is doubted."""
    late = np.zeros(grid.size) if grid.late_s is None else np.where(grid.pulse_width_us > 0, grid.late_s, 0.0)
    pulses = int(np.sum(np.abs(late) >= TOLD_S)) + _lost(grid)
    seconds = float(np.sum(grid.doubted[grid.count > 0])) * grid.step_s
    if not pulses and not seconds:
        return ""
    told = "1 pulse came late or was lost" if pulses == 1 else f"{pulses} pulses came late or were lost"
    if not seconds:
        return f"{told}; when each was felt is known, and nothing is left out."
    if not pulses:
        return f"{seconds:.1f} s are left out: what was applied is not known there."
    return f"{told}; {seconds:.1f} s are left out, where it is not known what was felt."


def refuse_doubted(grid: Grid) -> None:
    """Refuse a record of which next to nothing is known.

    Raises
    ------
    BadRecord
    """
    if np.sum(~grid.doubted & (grid.count > 0)) < LEAST:
        raise BadRecord("it is not known what was felt", place="doubted", mend="Give a record with other rows, too.")


def _lost(grid: Grid) -> int:
    known = grid.record.pulses
    if known is None:
        return 0
    inside = (known.time_s >= grid.start_s - grid.step_s) & (known.time_s <= grid.record.time_s[-1])
    return int(np.sum(known.lost & inside))

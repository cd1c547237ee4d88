"""The doubted samples of a record: which pulses acted there is not known, so they are not counted."""

from __future__ import annotations

import numpy as np

from identify.dynamics.pulse_grid import Grid
from identify.errors import BadRecord

TOLD_S = 5e-3
"""Pulses at least this late are reported: a fifth of an interval, more than the jitter of a healthy computer."""
LEAST = 8
"""Fewer known intervals are not enough for any result."""


def left_out(grid: Grid) -> str:
    """One sentence: how much is left out, and why; empty if no pulse was late or lost and no sample is doubted."""
    late = np.zeros(grid.size) if grid.late_s is None else np.where(grid.pulse_width_us > 0, grid.late_s, 0.0)
    pulses = int(np.sum(np.abs(late) >= TOLD_S)) + _lost(grid)
    seconds = float(np.sum(grid.doubted[grid.count > 0])) * grid.step_s
    if not pulses and not seconds:
        return ""
    told = "1 pulse came late or was lost" if pulses == 1 else f"{pulses} pulses came late or were lost"
    if not seconds:
        return f"{told}; the time of each is known, so nothing is left out."
    if not pulses:
        return f"{seconds:.1f} s are left out: the stimulation there is not known."
    return f"{told}; {seconds:.1f} s are left out, where the time of the pulses is not known."


def refuse_doubted(grid: Grid) -> None:
    """Refuse a record of which hardly any stimulation is known.

    Raises
    ------
    BadRecord
        Fewer than eight pulse intervals are known.
    """
    if np.sum(~grid.doubted & (grid.count > 0)) < LEAST:
        raise BadRecord("nearly all samples are doubted", place="doubted", fix="Give a record with known pulses.")


def _lost(grid: Grid) -> int:
    known = grid.record.pulses
    if known is None:
        return 0
    inside = (known.time_s >= grid.start_s - grid.step_s) & (known.time_s <= grid.record.time_s[-1])
    return int(np.sum(known.lost & inside))

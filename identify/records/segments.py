"""Segments of a record that names none: rest, prbs, ramp, multilevel and steps, found from the pulse widths."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from stimrig.identify.records.table import Table

REST_S = 0.9
"""The lowest width held as long is rest; in a PRBS it is held for some 0.6 s at most."""
EDGE_S = 0.2
"""At the record's begin and end this is enough."""
SMALL = 0.12
"""Share of the widths' range up to which a change may be one of a ramp."""
LEAST_CHANGES = 8
LONGEST_HOLD_S = 0.3
"""A ramp holds a width no longer; else it is a staircase."""
LEAST_PRBS = 4
MAX_LISTED = 8


def with_segments(table: Table) -> Table:
    """The same with a segment for each row; where they are found, with a note on them."""
    if "segment" in table.columns:
        return table
    time_s, width_us = table.columns["time_s"], table.columns["pulse_width_us"]
    first = np.append(0, np.flatnonzero(np.diff(width_us)) + 1)
    level = width_us[first]
    held_s = np.diff(np.append(time_s[first], time_s[-1]))
    lowest = level == level.min()
    resting = lowest & (held_s >= REST_S)
    resting[[0, -1]] |= lowest[[0, -1]] & (held_s[[0, -1]] >= EDGE_S)
    names: list[str] = []
    starts: list[int] = []
    for a, b in pairwise([0, *(np.flatnonzero(np.diff(resting)) + 1).tolist(), level.size]):
        for start, name in [(0, "rest")] if resting[a] else _active(level[a:b], held_s[a:b], np.ptp(level)):
            if not names or names[-1] != name:
                starts.append(int(first[a + start]))
                names.append(name)
    known = list(dict.fromkeys(names))
    code = np.repeat([known.index(name) for name in names], np.diff([*starts, width_us.size]))
    ends_s = [*time_s[starts[1:]], time_s[-1]]
    spans = [f"{name} {time_s[a]:.4g} to {end_s:.4g} s" for name, a, end_s in zip(names, starts, ends_s, strict=True)]
    more = f" and {len(spans) - MAX_LISTED} more" if len(spans) > MAX_LISTED else ""
    listed = f"{', '.join(spans[:MAX_LISTED])}{more}"
    note = f"no segment column: found from the pulse widths: {listed}; none is held out"
    return replace(table.noting(note, columns={"segment": code}), segment_names=known)


def _active(level: np.ndarray, held_s: np.ndarray, span_us: float) -> list[tuple[int, str]]:
    """The pieces of a stretch without rest, each with its first run."""
    edges = [0, *(np.flatnonzero(np.abs(np.diff(level)) > SMALL * span_us) + 1).tolist(), level.size]
    ramps = [(a, b) for a, b in pairwise(edges) if b - a > LEAST_CHANGES and np.median(held_s[a:b]) <= LONGEST_HOLD_S]
    pieces, done = [], 0
    for a, b in [*ramps, (level.size, level.size)]:
        if a > done:
            switching = "prbs" if a - done >= LEAST_PRBS else "steps"
            pieces.append((done, "multilevel" if np.unique(level[done:a]).size > 2 else switching))
        if b > a:
            pieces.append((a, "ramp"))
        done = b
    return pieces

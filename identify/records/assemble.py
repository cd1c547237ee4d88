"""Columns of another tool's file as a record: holes left out, times made even, segments found, all of it said."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from stimrig.identify.records import bounds, clock
from stimrig.identify.records.file_content import FileContent, check_numbers, check_widths, from_zero, without_holes
from stimrig.identify.records.record import Record

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


def find_segments(time_s: np.ndarray, width_us: np.ndarray) -> tuple[np.ndarray, list[str], str]:
    """A segment's number for each row, shape (N,), the names by number, and what to say of it."""
    first = np.append(0, np.flatnonzero(np.diff(width_us)) + 1)
    level = width_us[first]
    begin_s = np.append(time_s[first], time_s[-1])
    held_s = np.diff(begin_s)
    lowest = level == level.min()
    resting = lowest & (held_s >= REST_S)
    resting[[0, -1]] |= lowest[[0, -1]] & (held_s[[0, -1]] >= EDGE_S)
    names: list[str] = []
    starts: list[int] = []
    edges = np.flatnonzero(np.diff(resting)) + 1
    for a, b in zip([0, *edges.tolist()], [*edges.tolist(), level.size], strict=True):
        pieces = [(a, "rest")] if resting[a] else _active(level[a:b], held_s[a:b], a, np.ptp(level))
        for start, name in pieces:
            if not names or names[-1] != name:
                starts.append(int(first[start]))
                names.append(name)
    known = list(dict.fromkeys(names))
    lengths = np.diff([*starts, width_us.size])
    code = np.repeat([known.index(name) for name in names], lengths)
    return code, known, _note(names, time_s[starts], float(time_s[-1]))


def _active(level: np.ndarray, held_s: np.ndarray, offset: int, span_us: float) -> list[tuple[int, str]]:
    """The pieces of a stretch without rest, each with its first run."""
    jumps = np.flatnonzero(np.abs(np.diff(level)) > SMALL * span_us) + 1
    edges = [0, *jumps.tolist(), level.size]
    ramps = [(a, b) for a, b in pairwise(edges) if b - a > LEAST_CHANGES and np.median(held_s[a:b]) <= LONGEST_HOLD_S]
    pieces, done = [], 0
    for a, b in [*ramps, (level.size, level.size)]:
        if a > done:
            pieces.append((offset + done, _switching(level[done:a])))
        if b > a:
            pieces.append((offset + a, "ramp"))
        done = b
    return pieces


def _switching(level: np.ndarray) -> str:
    if np.unique(level).size > 2:
        return "multilevel"
    return "prbs" if level.size >= LEAST_PRBS else "steps"


def _note(names: list[str], starts_s: np.ndarray, end_s: float) -> str:
    ends_s = np.append(starts_s[1:], end_s)
    spans = [f"{name} {a:.4g} to {b:.4g} s" for name, a, b in zip(names, starts_s, ends_s, strict=True)]
    more = f" and {len(spans) - MAX_LISTED} more" if len(spans) > MAX_LISTED else ""
    return f"no segment column: found from the pulse widths: {', '.join(spans[:MAX_LISTED])}{more}; none is held out"


def record_of(file: FileContent) -> Record:
    """Make the record of a file, with notes on all assumptions. Raises BadRecord: with the place and the fix."""
    check_numbers(file)
    file = from_zero(without_holes(file))
    check_widths(file)
    time_s = file.columns["time_s"]
    bounds.check_span(time_s, file.at(time_s.size - 1))
    file = clock.regular(file)
    if "segment" not in file.columns:
        code, names, note = find_segments(file.columns["time_s"], file.columns["pulse_width_us"])
        file = file.noting(note, names=names, columns=file.columns | {"segment": code})
    return file.record()

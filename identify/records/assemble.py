"""Columns of another tool's file as a record: holes left out, times made even, segments found, all of it said."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds, clock
from stimrig.identify.records.columns import MAY_LACK
from stimrig.identify.records.record import OPTIONAL, Record, Source

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
MOST_TOLD = 8


def find_segments(time_s: np.ndarray, width_us: np.ndarray) -> tuple[np.ndarray, list[str], str]:
    """A segment's number for each row, shape (N,), the names by number, and what to say of it."""
    first = np.append(0, np.flatnonzero(np.diff(width_us)) + 1)
    level = width_us[first]
    begin_s = np.append(time_s[first], time_s[-1])
    held_s = np.diff(begin_s)
    resting = _resting(level, held_s)
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
    return code, known, _note(names, time_s[starts], float(time_s[-1]), float(level.min()))


def _resting(level: np.ndarray, held_s: np.ndarray) -> np.ndarray:
    """For each run of one width whether it is rest."""
    lowest = level == level.min()
    resting = lowest & (held_s >= REST_S)
    resting[[0, -1]] |= lowest[[0, -1]] & (held_s[[0, -1]] >= EDGE_S)
    return resting


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


def _note(names: list[str], starts_s: np.ndarray, end_s: float, lowest_us: float) -> str:
    ends_s = np.append(starts_s[1:], end_s)
    told = [f"{name} {a:.4g} to {b:.4g} s" for name, a, b in zip(names, starts_s, ends_s, strict=True)]
    more = f" and {len(told) - MOST_TOLD} more" if len(told) > MOST_TOLD else ""
    low = f"; the lowest width, {lowest_us:.4g} µs, is taken as rest" if lowest_us > 0 and "rest" in names else ""
    return f"no segment column: found from the pulse widths: {', '.join(told[:MOST_TOLD])}{more}; none is held out{low}"


LEAST_LARGEST_US = 1.0
"""A record whose largest pulse width is less has it in another unit."""
MOST_HOLES = 0.1
"""Share of rows without a number up to which the others are a record."""
PULSE_RATE_HZ = 40.0
Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class FileContent:
    """What a file of another tool holds.

    Parameters
    ----------
    columns : dict of ndarray, shape (N,)
        In our units, by our names; NaN where the file has no number.
    segment : ndarray of int or None, shape (N,)
        Index into `names` for each row; None where the file has none.
    names : sequence of str
        Segments.
    name : str
        How messages call the file.
    cell : callable
        How messages call a cell in it, by row and column.
    source : Source
        The file, with notes on how it was read.
    pulse_rate_hz : float
        Pulses a second.
    """

    columns: Columns
    segment: np.ndarray | None
    names: Sequence[str]
    name: str
    cell: Callable[[int, str], str]
    source: Source
    pulse_rate_hz: float = PULSE_RATE_HZ

    def at(self, row: int, column: str) -> str:
        """How errors call a cell: with the file."""
        return f"{self.name}, {self.cell(row, column)}"

    def noting(self, *notes: str, **changes: object) -> FileContent:
        """The same with changes, and with more to say."""
        source = replace(self.source, notes=(*self.source.notes, *(note for note in notes if note)))
        return replace(self, source=source, **changes)  # pyright: ignore[reportArgumentType]


def record_of(found: FileContent) -> Record:
    """The record, with notes on all that was assumed. Raises BadRecord: with the place and what to do."""
    check_numbers(found.columns, found.at)
    found = _from_zero(without_holes(found))
    check_widths(found.columns, found.at)
    time_s = found.columns["time_s"]
    bounds.check_span(time_s, found.at(time_s.size - 1, "time_s"))
    rows = found.columns if found.segment is None else {**found.columns, "segment": found.segment}
    even, notes = clock.regular(
        rows, lambda row: found.at(row, "time_s"), lambda row: found.cell(row, "time_s"), found.pulse_rate_hz
    )
    if found.segment is None:
        even["segment"], names, note = find_segments(even["time_s"], even["pulse_width_us"])
        notes.append(note)
        found = replace(found, names=names)
    found = found.noting(*notes)
    return Record.from_arrays(
        even["time_s"],
        even["pulse_width_us"],
        even["torque_nm"],
        even["segment"],
        segment_names=found.names,
        pulse_rate_hz=found.pulse_rate_hz,
        source=found.source,
        **optional(even),
    )


def optional(columns: Columns) -> dict[str, Any]:
    """Those of the columns that a record may have or not."""
    return {name: columns[name] for name in OPTIONAL if name in columns}


def check_numbers(columns: Columns, at: Callable[[int, str], str]) -> None:
    """Refuse numbers that no measurement gives; NaN stands where there is none, in the columns that may lack one.

    Raises BadRecord: infinite, or beyond what is measured.
    """
    for name, column in columns.items():
        missing = np.isnan(column) if name in MAY_LACK else False
        if (bad := np.flatnonzero(~(np.abs(column) <= bounds.largest(name)) & ~np.asarray(missing))).size:
            fix = "Cut the record before it; values must be finite."
            fix = bounds.fix_of(name, column[bad], fix)
            raise BadRecord(f"{column[bad[0]]:g} is no measurement", place=at(int(bad[0]), name), fix=fix)


def without_holes(found: FileContent) -> FileContent:
    """Without the rows in which a number is missing: they are gaps like any other.

    Raises BadRecord: too many of them.
    """
    holes = {name: np.isnan(column) for name, column in found.columns.items()}
    rows = np.logical_or.reduce(list(holes.values()))
    count = int(np.count_nonzero(rows))
    if not count:
        return found
    first = int(np.argmax(rows))
    column = next(name for name, hole in holes.items() if hole[first])
    if count > MOST_HOLES * rows.size:
        message = f"no number here, nor in {count - 1} of {rows.size} rows" if count > 1 else "no number"
        raise BadRecord(
            message, place=found.at(first, column), fix=f"At most {100 * MOST_HOLES:.0f} % of the rows may lack one."
        )
    kept = np.flatnonzero(~rows)
    times = "1 row is" if count == 1 else f"{count} rows are"
    return found.noting(
        f"{times} left out for want of a number (first at {found.cell(first, column)})",
        columns={name: column[kept] for name, column in found.columns.items()},
        segment=None if found.segment is None else found.segment[kept],
        cell=lambda row, column: found.cell(int(kept[row]), column),
    )


def _from_zero(found: FileContent) -> FileContent:
    """With times counted from the first sample where they are those of a calendar."""
    time_s = found.columns["time_s"]
    if not np.max(np.abs(time_s), initial=0.0) > bounds.LARGEST["time_s"]:
        return found
    return found.noting(
        f"time is counted from the first sample, at {time_s[0]:.3f} s",
        columns={**found.columns, "time_s": time_s - time_s[0]},
    )


def check_widths(columns: Columns, at: Callable[[int, str], str]) -> None:
    """Refuse widths and flags that no measurement gives.

    Raises BadRecord: negative widths, widths in another unit, flags that are neither 0 nor 1.
    """
    width_us = columns["pulse_width_us"]
    if (negative := np.flatnonzero(width_us < 0)).size:
        raise BadRecord(
            f"{width_us[negative[0]]:g} µs is negative",
            place=at(int(negative[0]), "pulse_width_us"),
            fix="A pulse width is 0 (no pulse) or positive.",
        )
    largest_us = float(np.max(width_us, initial=0.0))
    if 0.0 < largest_us < LEAST_LARGEST_US:
        raise BadRecord(
            f"the largest is {largest_us:g} µs, and no stimulator gives so little",
            place=at(int(width_us.argmax()), "pulse_width_us"),
            fix="Give µs: multiply seconds by 1000000, milliseconds by 1000; or say the unit, "
            "for instance --map pulse_width_us=pulse_width_us:s.",
        )
    doubted = columns.get("doubted", np.zeros(0))
    if (bad := np.flatnonzero((doubted != 0) & (doubted != 1))).size:
        raise BadRecord(
            f"{doubted[bad[0]]:g} is neither 0 nor 1",
            place=at(int(bad[0]), "doubted"),
            fix="1 is a row in which it is not known what was felt, 0 any other.",
        )

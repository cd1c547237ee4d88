"""Columns of another tool's file as a record: holes left out, times made even, segments found, all of it said."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds, clock, segments
from stimrig.identify.records.columns import MAY_LACK
from stimrig.identify.records.record import OPTIONAL, Record, Source

LEAST_LARGEST_US = 1.0
"""A record whose largest pulse width is less has it in another unit."""
MOST_HOLES = 0.1
"""Share of rows without a number up to which the others are a record."""
PULSE_RATE_HZ = 40.0
Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Found:
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

    def noting(self, *notes: str, **changes: object) -> Found:
        """The same with changes, and with more to say."""
        source = replace(self.source, notes=(*self.source.notes, *(note for note in notes if note)))
        return replace(self, source=source, **changes)  # pyright: ignore[reportArgumentType]


def record_of(found: Found) -> Record:
    """The record, with notes on all that was assumed.

    Raises
    ------
    BadRecord
        With the place and what to do.
    """
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
        even["segment"], names, note = segments.found(even["time_s"], even["pulse_width_us"])
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

    Raises
    ------
    BadRecord
        Infinite, or beyond what is measured.
    """
    for name, column in columns.items():
        missing = np.isnan(column) if name in MAY_LACK else False
        if (bad := np.flatnonzero(~(np.abs(column) <= bounds.largest(name)) & ~np.asarray(missing))).size:
            fix = "Cut the record before it; values must be finite."
            fix = bounds.fix_of(name, column[bad], fix)
            raise BadRecord(f"{column[bad[0]]:g} is no measurement", place=at(int(bad[0]), name), fix=fix)


def without_holes(found: Found) -> Found:
    """Without the rows in which a number is missing: they are gaps like any other.

    Raises
    ------
    BadRecord
        Too many of them.
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


def _from_zero(found: Found) -> Found:
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

    Raises
    ------
    BadRecord
        Negative widths, widths in another unit, flags that are neither 0 nor 1.
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

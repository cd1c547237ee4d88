"""Contents of another tool's file, and checks that a measurement can have given them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.columns import Column
from stimrig.identify.records.record import Record, Source

LEAST_LARGEST_US = 1.0
"""A record whose largest pulse width is less has it in another unit."""
MOST_HOLES = 0.1
"""Share of rows without a number up to which the others are a record."""
PULSE_RATE_HZ = 40.0


@dataclass(frozen=True)
class FileContent:
    """Columns of a file of another tool, before checks."""

    columns: dict[str, np.ndarray]
    """In our units, by our names, each of shape (N,); NaN where the file has no number. A `segment`, where it has one,
    is an index into `names` for each row."""
    names: Sequence[str]  # segments
    name: str  # how messages call the file
    cell: Callable[[int, str], str]  # how messages call a cell in it, by row and column
    source: Source  # the file, with notes on how it was read
    pulse_rate_hz: float = PULSE_RATE_HZ  # pulses a second

    def at(self, row: int, column: str = "time_s") -> str:
        """Name a cell, with the file, in messages."""
        return f"{self.name}, {self.cell(row, column)}"

    def noting(self, *notes: str, **changes: object) -> FileContent:
        """The same with changes, and with more to say."""
        source = replace(self.source, notes=(*self.source.notes, *(note for note in notes if note)))
        return replace(self, source=source, **changes)  # type: ignore

    def record(self, **more: object) -> Record:
        """The columns as a record, as they are; `more` is what else `Record.from_arrays` takes."""
        low_us = float(np.min(self.columns["pulse_width_us"], initial=np.inf))
        source = self.noting(f"the lowest width, {low_us:.4g} µs, is taken as rest" if low_us > 0 else "").source
        known = {"segment_names": self.names, "pulse_rate_hz": self.pulse_rate_hz, "source": source}
        return Record.from_arrays(**self.columns, **known, **more)  # type: ignore


def file_source(content: bytes, path: Path, known: Mapping[str, Column], *written: str) -> Source:
    """The file as the source of a record, with notes on how it is written, and on its columns."""
    columns = "; ".join(column.note for column in known.values() if column.note)
    notes = tuple(note for note in (*written, columns) if note)
    return Source(path.name, sha256=hashlib.sha256(content).hexdigest(), notes=notes)


def check_numbers(file: FileContent) -> None:
    """Refuse numbers that no measurement gives. Raises BadRecord: infinite, or beyond what is measured."""
    for name, column in file.columns.items():
        if name != "segment" and (bad := bounds.wrong_rows(name, column)).size:
            fix = bounds.fix_of(name, column[bad], "Cut the record before it; values must be finite.")
            raise BadRecord(f"{column[bad[0]]:g} is no measurement", place=file.at(int(bad[0]), name), fix=fix)


def without_holes(file: FileContent) -> FileContent:
    """Without the rows in which a number is missing: they are gaps like any other.

    Raises BadRecord: too many of them.
    """
    holes = {name: np.isnan(column) for name, column in file.columns.items()}
    rows = np.logical_or.reduce(list(holes.values()))
    count = int(np.count_nonzero(rows))
    if not count:
        return file
    first = int(np.argmax(rows))
    column = next(name for name, hole in holes.items() if hole[first])
    if count > MOST_HOLES * rows.size:
        message = f"no number here, nor in {count - 1} of {rows.size} rows" if count > 1 else "no number"
        fix = f"At most {100 * MOST_HOLES:.0f} % of the rows may lack one."
        raise BadRecord(message, place=file.at(first, column), fix=fix)
    complete_rows = np.flatnonzero(~rows)
    times = "1 row is" if count == 1 else f"{count} rows are"
    return file.noting(
        f"{times} left out for want of a number (first at {file.cell(first, column)})",
        columns={name: column[complete_rows] for name, column in file.columns.items()},
        cell=lambda row, column: file.cell(int(complete_rows[row]), column),
    )


def from_zero(file: FileContent) -> FileContent:
    """With times counted from the first sample where they are those of a calendar."""
    time_s = file.columns["time_s"]
    if not np.max(np.abs(time_s), initial=0.0) > bounds.LARGEST["time_s"]:
        return file
    note = f"time is counted from the first sample, at {time_s[0]:.3f} s"
    return file.noting(note, columns=file.columns | {"time_s": time_s - time_s[0]})


def check_widths(file: FileContent) -> None:
    """Refuse widths and flags that no measurement gives.

    Raises BadRecord: negative widths, widths in another unit, flags that are neither 0 nor 1.
    """
    width_us = file.columns["pulse_width_us"]
    if (negative := np.flatnonzero(width_us < 0)).size:
        fix = "A pulse width is 0 (no pulse) or positive."
        place = file.at(int(negative[0]), "pulse_width_us")
        raise BadRecord(f"{width_us[negative[0]]:g} µs is negative", place=place, fix=fix)
    largest_us = float(np.max(width_us, initial=0.0))
    if 0.0 < largest_us < LEAST_LARGEST_US:
        raise BadRecord(
            f"the largest is {largest_us:g} µs, and no stimulator gives so little",
            place=file.at(int(width_us.argmax()), "pulse_width_us"),
            fix="Give µs: multiply seconds by 1000000, milliseconds by 1000; or say the unit, "
            "for instance --map pulse_width_us=pulse_width_us:s.",
        )
    doubted = file.columns.get("doubted", np.zeros(0))
    if (bad := np.flatnonzero((doubted != 0) & (doubted != 1))).size:
        fix = "1 is a row in which it is not known what was felt, 0 any other."
        place = file.at(int(bad[0]), "doubted")
        raise BadRecord(f"{doubted[bad[0]]:g} is neither 0 nor 1", place=place, fix=fix)

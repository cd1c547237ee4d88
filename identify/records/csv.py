"""A record from a CSV file: fast where it is sound, exact about line and column where it is not.

It is read in blocks of rows, so that memory follows the numbers it holds and not what else is in the file.
"""

from __future__ import annotations

import csv
import hashlib
import io
from array import array
from collections.abc import Iterator, Sequence
from itertools import islice, pairwise
from pathlib import Path

import numpy as np

from identify.errors import BadRecord
from identify.records import bounds, parts_csv
from identify.records.bounds import LARGEST
from identify.records.record import OPTIONAL, Part, Record, Source, joined_source

REQUIRED = ("time_s", "pulse_width_us", "torque_nm", "segment")
PAUSE_S = 1.0
"""A jump of the clock as long as this, at zero pulse width, is a pause between two tests."""
MOST_PAUSES = 1000
HEADER = ",".join(REQUIRED)
BLOCK = 4096
LONGEST_LINE = 10_000
"""Characters; no row of numbers has as many."""
LEAST_LARGEST_US = 1.0
"""A record whose largest pulse width is less has it in another unit."""
SEPARATED = "Separate with commas, not {!r}, and write numbers with a decimal point."
CUT = "Every row needs every column; was the file cut off?"


def read_csv(content: bytes, path: Path, pulse_rate_hz: float | None = None) -> Record:
    """A CSV record from its bytes; `path` is how it is called. Pulses come at 40 Hz, unless it or the caller says else.

    Raises
    ------
    BadRecord
        With file, line and column, and the mend.
    """
    name = str(path)
    table = _Table(name)
    reader = csv.reader(_text_lines(content, name))
    try:
        table.fill(reader)
    except UnicodeDecodeError:
        place = f"{name}, line {_undecodable(content)}"
        raise BadRecord("not UTF-8 text", place=place, mend="Save the file as UTF-8 CSV.") from None
    except csv.Error as error:
        place = f"{name}, line {reader.line_num}"
        raise BadRecord(f"not CSV ({error})", place=place, mend="Save the file as comma-separated text.") from error
    columns, lines = {column: np.array(values) for column, values in table.numbers.items()}, table.lines
    if not lines:
        raise BadRecord("no row under the header", place=f"{name}, line 2", mend="Give a few seconds of data.")
    source = Source(name=path.name, sha256=hashlib.sha256(content).hexdigest())
    joined = parts_csv.parsed(columns, table.parts, lines, name) if "part" in columns else None
    if joined is None:
        time_s = _even_parts(columns["time_s"], columns["pulse_width_us"], lines, name)
    else:
        time_s, source = columns["time_s"], joined_source(joined.sources, source.name, source.sha256)
    bounds.check_span(time_s, f"{name}, line {lines[-1]}, column time_s")
    if (negative := np.flatnonzero(columns["pulse_width_us"] < 0)).size:
        raise BadRecord(
            f"{columns['pulse_width_us'][negative[0]]:g} µs is negative",
            place=f"{name}, line {lines[negative[0]]}, column pulse_width_us",
            mend="A pulse width is 0 (no pulse) or positive.",
        )
    largest_us = float(columns["pulse_width_us"].max())
    if 0.0 < largest_us < LEAST_LARGEST_US:
        raise BadRecord(
            f"the largest is {largest_us:g} µs, and no stimulator gives so little",
            place=f"{name}, line {lines[int(columns['pulse_width_us'].argmax())]}, column pulse_width_us",
            mend="Give µs: multiply seconds by 1000000, milliseconds by 1000.",
        )
    doubted = columns.get("doubted", np.zeros(0))
    if (bad := np.flatnonzero((doubted != 0) & (doubted != 1))).size:
        raise BadRecord(
            f"{doubted[bad[0]]:g} is neither 0 nor 1",
            place=f"{name}, line {lines[bad[0]]}, column doubted",
            mend="1 is a row in which it is not known what was felt, 0 any other.",
        )
    return Record.from_arrays(
        time_s,
        columns["pulse_width_us"],
        columns["torque_nm"],
        np.array(table.segment),
        segment_names=list(table.names),
        pulses=None,
        pulse_rate_hz=pulse_rate_hz or (joined.pulse_rate_hz if joined else None) or 40.0,
        source=source,
        parts=joined.parts if joined else (Part(),),
        **{column: columns[column] for column in OPTIONAL if column in columns},
    )


def _text_lines(content: bytes, name: str) -> Iterator[str]:
    """The file's lines, none too long and not too many."""
    file = io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", newline="")
    for number, line in enumerate(file, start=1):
        if len(line) > LONGEST_LINE:
            mend = "One row a line, separated by commas; is it text at all?"
            raise BadRecord(f"more than {LONGEST_LINE} characters", place=f"{name}, line {number}", mend=mend)
        if number > bounds.LARGEST_ROWS:
            mend = "Cut the record, or resample it to a lower rate."
            raise BadRecord(f"more than {bounds.LARGEST_ROWS} lines", place=f"{name}, line {number}", mend=mend)
        yield line


def _undecodable(content: bytes) -> int:
    """The number of the first line that is no UTF-8."""
    for number, line in enumerate(io.BytesIO(content), start=1):
        try:
            line.decode("utf-8")
        except UnicodeDecodeError:
            return number
    return 1


class _Table:
    """What the rows hold: numbers by column, segments by name, and the line each row stands in."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.lines = array("L")
        self.segment = array("L")
        self.names: dict[str, int] = {}
        self.numbers: dict[str, array[float]] = {}
        self.place: dict[str, int] = {}
        self.parts: dict[int, dict[str, str]] = {}
        """Cells that describe a part, by the row that it begins with."""

    def fill(self, reader: Iterator[list[str]]) -> None:
        """Take all rows in; blank lines are passed over."""
        self.place = _header(next(reader, []), self.name)
        self.numbers = {column: array("d") for column in self.place if column not in ("segment", *parts_csv.CELLS)}
        rows = ((reader.line_num, row) for row in reader if row)  # pyright: ignore[reportAttributeAccessIssue]
        while block := list(islice(rows, BLOCK)):
            self._take([row for _, row in block], [line for line, _ in block])

    def _take(self, rows: list[list[str]], lines: list[int]) -> None:
        for column, values in self.numbers.items():
            values.extend(self._column(rows, column, lines))
        if "part" in self.place:
            self._take_parts(rows, lines)
        at = self.place["segment"]
        for row, line in zip(rows, lines, strict=True):
            if len(row) <= at:
                raise self._short(row, line, "segment")
            text = row[at].strip()
            code = self.names.get(text)
            self.segment.append(self._new_name(text, line) if code is None else code)
        self.lines.extend(lines)

    def _take_parts(self, rows: list[list[str]], lines: list[int]) -> None:
        """Keep the cells of each row with which a part begins."""
        before = len(self.lines)
        number = np.array(self.numbers["part"][max(before - 1, 0) :])
        firsts = np.flatnonzero(np.diff(number)) + (0 if before else 1)
        cells = {column: self.place[column] for column in parts_csv.CELLS if column in self.place}
        for index in firsts.tolist() if before else [0, *firsts.tolist()]:
            row = rows[index]
            if len(row) <= max(cells.values()):
                raise self._short(row, lines[index], "pause_s")
            self.parts[before + index] = {column: row[at].strip() for column, at in cells.items()}
            if len(self.parts) > bounds.MOST_PARTS:
                mend = f"At most {bounds.MOST_PARTS} in one record."
                raise BadRecord("too many parts", place=self._at(lines[index], "part"), mend=mend)

    def _column(self, rows: list[list[str]], column: str, lines: list[int]) -> np.ndarray:
        at = self.place[column]
        try:
            cells = [row[at] for row in rows]
            values = np.array([float(cell) for cell in cells])
        except (IndexError, ValueError):
            raise self._first_bad(rows, column, lines) from None
        # Python's float also takes digits of other scripts and underscores, which no measuring tool writes.
        text = "".join(cells)
        if not text.isascii() or "_" in text:
            raise self._first_bad(rows, column, lines)
        bad = np.flatnonzero(~(np.abs(values) <= LARGEST[column]))
        if bad.size:
            raise BadRecord(
                f"{_short(rows[bad[0]][at].strip())} is no measurement",
                place=self._at(lines[bad[0]], column),
                mend="Remove the row's cause, or cut the record before it; values must be finite.",
            )
        return values

    def _first_bad(self, rows: list[list[str]], column: str, lines: list[int]) -> BadRecord:
        at = self.place[column]
        for row, line in zip(rows, lines, strict=True):
            if len(row) <= at:
                return self._short(row, line, column)
            if not _is_number(row[at]):
                message = f"{_short(row[at])!r} is no number" if row[at].strip() else "empty"
                return BadRecord(message, place=self._at(line, column), mend="Give a number with a decimal point.")
        raise AssertionError("a row that could not be read can be read")

    def _new_name(self, text: str, line: int) -> int:
        bounds.check_name(text, self._at(line, "segment"))
        if len(self.names) == bounds.MOST_SEGMENTS:
            mend = "Name segments by what they are (rest, prbs…), not each row."
            raise BadRecord(f"more than {bounds.MOST_SEGMENTS} names", place=self._at(line, "segment"), mend=mend)
        return self.names.setdefault(text, len(self.names))

    def _short(self, row: list[str], line: int, column: str) -> BadRecord:
        return BadRecord(f"only {len(row)} cells", place=self._at(line, column), mend=CUT)

    def _at(self, line: int, column: str) -> str:
        return f"{self.name}, line {line}, column {column}"


def _header(first: list[str], name: str) -> dict[str, int]:
    """Column of each known name."""
    if not any(cell.strip() for cell in first):
        raise BadRecord("empty", place=f"{name}, line 1", mend=f"The first line must be {HEADER}.")
    header = [cell.strip() for cell in first]
    missing = [column for column in REQUIRED if column not in header]
    if missing:
        separator = next((mark for mark in ";\t" if len(header) == 1 and mark in header[0]), None)
        mend = SEPARATED.format(separator) if separator else f"The first line must be {HEADER}."
        raise BadRecord(f"no column {', '.join(missing)}", place=f"{name}, line 1", mend=mend)
    # One of them alone is a column of somebody else's.
    of_parts = ("part", *parts_csv.CELLS) if {"part", "pause_s"} <= set(header) else ()
    known = (*REQUIRED, *OPTIONAL, *of_parts)
    twice = [column for column in known if header.count(column) > 1]
    if twice:
        raise BadRecord(f"column {twice[0]} is there twice", place=f"{name}, line 1", mend="Keep one of them.")
    return {column: header.index(column) for column in known if column in header}


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell


def _short(cell: str) -> str:
    return cell if len(cell) <= 40 else f"{cell[:40]}…"


def _even_parts(time_s: np.ndarray, width_us: np.ndarray, lines: Sequence[int], name: str) -> np.ndarray:
    """As `uniform_time`, each part by itself: tests of one session may follow one another after a pause at rest."""
    steps = np.diff(time_s)
    least_s = max(PAUSE_S, 20 * float(np.median(steps))) if steps.size else PAUSE_S
    jumps = np.flatnonzero((steps >= least_s) & (width_us[:-1] == 0) & (width_us[1:] == 0)) + 1
    if jumps.size > MOST_PAUSES:
        place = f"{name}, line {lines[jumps[MOST_PAUSES]]}, column time_s"
        raise BadRecord(f"more than {MOST_PAUSES} pauses", place=place, mend="Give a record without holes.")
    edges = [0, *jumps.tolist(), time_s.size]
    parts = [uniform_time(time_s[a:b], lines[a:b], name) for a, b in pairwise(edges)]
    for part, edge in zip(parts, edges, strict=False):
        step, first = float(part[1] - part[0]), float(parts[0][1] - parts[0][0])
        if abs(step - first) > 0.002 * first:
            raise BadRecord(
                f"sampled at {1 / step:.4g} Hz after a pause, {1 / first:.4g} Hz before it ({part.size} rows)",
                place=f"{name}, line {lines[edge]}, column time_s",
                mend="Resample to one rate.",
            )
    return np.concatenate(parts)


def uniform_time(time_s: np.ndarray, lines: Sequence[int], name: str) -> np.ndarray:
    """Times freed of the rounding they were written with.

    Raises
    ------
    BadRecord
        Running backwards, uneven, or at a rate that can't be used.
    """

    def at(index: int) -> str:
        return f"{name}, line {lines[index]}, column time_s"

    if time_s.size < 8:
        raise BadRecord(f"only {time_s.size} samples", place=at(0), mend="Give a few seconds of data.")
    gaps = np.diff(time_s)
    backwards = np.flatnonzero(~(gaps > 0))
    if backwards.size:
        index = int(backwards[0]) + 1
        verb = "stands still" if gaps[index - 1] == 0 else "runs backwards"
        raise BadRecord(
            f"time {verb} at {time_s[index]:g} s", place=at(index), mend="Sort the rows by time, once each."
        )
    slope = float(time_s[-1] - time_s[0]) / (time_s.size - 1)
    typical = float(np.median(gaps))
    uneven = np.flatnonzero(np.abs(gaps - typical) > 0.75 * typical)
    if uneven.size:
        index = int(uneven[0]) + 1
        raise BadRecord(
            f"uneven sampling: {gaps[index - 1]:.6g} s after steps of {typical:.6g} s",
            place=at(index),
            mend="Resample to one rate, or give the sealed recording, which knows its gaps.",
        )
    line = time_s[0] + slope * np.arange(time_s.size)
    # Rounding shifts all times alike: centre the line on the times that were written.
    line += float(np.median(time_s - line))
    far = np.flatnonzero(np.abs(time_s - line) > 0.75 * slope)
    if far.size:
        raise BadRecord("uneven sampling: the rate changes", place=at(int(far[0])), mend="Resample to one rate.")
    bounds.check_sampling(1 / slope, at(0))
    return line

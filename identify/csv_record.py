"""A record from a CSV file: fast where it is sound, exact about line and column where it is not."""

from __future__ import annotations

import csv
import hashlib
import io
from itertools import pairwise
from pathlib import Path

import numpy as np

from identify.errors import BadRecord
from identify.record import Record, Source

REQUIRED = ("time_s", "pulse_width_us", "torque_nm", "segment")
OPTIONAL = ("angle_rad", "velocity_rad_s")
PAUSE_S = 1.0
"""A jump of the clock as long as this, at zero pulse width, is a pause between two tests."""
HEADER = ",".join(REQUIRED)
LOWEST_HZ, HIGHEST_HZ = 39.0, 2100.0
LARGEST = {"time_s": 1e7, "pulse_width_us": 1e4, "torque_nm": 1e6, "angle_rad": 1e3, "velocity_rad_s": 1e5}


def read_csv(path: Path, pulse_rate_hz: float = 40.0) -> Record:
    """Read a CSV record.

    Raises
    ------
    BadRecord
        With file, line and column, and the mend.
    """
    content = path.read_bytes()
    name = str(path)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise BadRecord("not UTF-8 text", place=f"{name}, line {line}", mend="Save the file as UTF-8 CSV.") from error
    try:
        rows = list(csv.reader(io.StringIO(text, newline="")))
    except csv.Error as error:
        raise BadRecord(f"not CSV ({error})", place=name, mend="Save the file as comma-separated text.") from error
    place = _header(rows, name)
    lines = _lines(rows)
    body = [rows[line - 1] for line in lines]
    if not body:
        raise BadRecord("no row under the header", place=f"{name}, line 2", mend="Give a few seconds of data.")
    columns = {column: _numbers(body, at, column, lines, name) for column, at in place.items() if column != "segment"}
    try:
        segment = np.array([row[place["segment"]].strip() for row in body])
    except IndexError:
        raise _short_row(body, place["segment"], "segment", lines, name) from None
    if (empty := np.flatnonzero(segment == "")).size:
        raise BadRecord(
            "empty",
            place=f"{name}, line {lines[empty[0]]}, column segment",
            mend="Name it: rest, prbs, ramp, validate…",
        )
    time_s = _even_parts(columns["time_s"], columns["pulse_width_us"], lines, name)
    if (negative := np.flatnonzero(columns["pulse_width_us"] < 0)).size:
        raise BadRecord(
            f"{columns['pulse_width_us'][negative[0]]:g} µs is negative",
            place=f"{name}, line {lines[negative[0]]}, column pulse_width_us",
            mend="A pulse width is 0 (no pulse) or positive.",
        )
    return Record.from_arrays(
        time_s,
        columns["pulse_width_us"],
        columns["torque_nm"],
        segment,
        angle_rad=columns.get("angle_rad"),
        velocity_rad_s=columns.get("velocity_rad_s"),
        pulse_rate_hz=pulse_rate_hz,
        source=Source(name=path.name, sha256=hashlib.sha256(content).hexdigest()),
    )


def _header(rows: list[list[str]], name: str) -> dict[str, int]:
    """Column of each known name."""
    if not rows or not any(cell.strip() for cell in rows[0]):
        raise BadRecord("empty", place=f"{name}, line 1", mend=f"The first line must be {HEADER}.")
    header = [cell.strip() for cell in rows[0]]
    missing = [column for column in REQUIRED if column not in header]
    if missing:
        separator = next((mark for mark in ";\t" if len(header) == 1 and mark in header[0]), None)
        mend = f"Separate with commas, not {separator!r}." if separator else f"The first line must be {HEADER}."
        raise BadRecord(f"no column {', '.join(missing)}", place=f"{name}, line 1", mend=mend)
    twice = [column for column in REQUIRED + OPTIONAL if header.count(column) > 1]
    if twice:
        raise BadRecord(f"column {twice[0]} is there twice", place=f"{name}, line 1", mend="Keep one of them.")
    return {column: header.index(column) for column in REQUIRED + OPTIONAL if column in header}


def _lines(rows: list[list[str]]) -> list[int]:
    """Line numbers of the rows that hold something (blank lines are passed over)."""
    return [number for number, row in enumerate(rows[1:], start=2) if row]


def _short_row(body: list[list[str]], at: int, column: str, lines: list[int], name: str) -> BadRecord:
    index = next(i for i, row in enumerate(body) if len(row) <= at)
    return BadRecord(
        f"only {len(body[index])} cells",
        place=f"{name}, line {lines[index]}, column {column}",
        mend="Every row needs every column; was the file cut off?",
    )


def _numbers(body: list[list[str]], at: int, column: str, lines: list[int], name: str) -> np.ndarray:
    try:
        values = np.array([float(row[at]) for row in body])
    except IndexError:
        raise _short_row(body, at, column, lines, name) from None
    except ValueError:
        index, cell = next((i, row[at]) for i, row in enumerate(body) if len(row) > at and not _is_number(row[at]))
        raise BadRecord(
            f"{cell!r} is no number" if cell.strip() else "empty",
            place=f"{name}, line {lines[index]}, column {column}",
            mend="Give a number with a decimal point.",
        ) from None
    bad = np.flatnonzero(~(np.abs(values) <= LARGEST[column]))
    if bad.size:
        raise BadRecord(
            f"{body[bad[0]][at].strip()} is no measurement",
            place=f"{name}, line {lines[bad[0]]}, column {column}",
            mend="Remove the row's cause, or cut the record before it; values must be finite.",
        )
    return values


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _even_parts(time_s: np.ndarray, width_us: np.ndarray, lines: list[int], name: str) -> np.ndarray:
    """As `uniform_time`, each part by itself: tests of one session may follow one another after a pause at rest."""
    steps = np.diff(time_s)
    least_s = max(PAUSE_S, 20 * float(np.median(steps))) if steps.size else PAUSE_S
    jumps = np.flatnonzero((steps >= least_s) & (width_us[:-1] == 0) & (width_us[1:] == 0)) + 1
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


def uniform_time(time_s: np.ndarray, lines: list[int], name: str) -> np.ndarray:
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
    if not LOWEST_HZ <= 1 / slope <= HIGHEST_HZ:
        raise BadRecord(f"sampled at {1 / slope:.4g} Hz", place=at(0), mend="40 Hz to 2 kHz can be used.")
    return line

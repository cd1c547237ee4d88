"""A joined record as a CSV file, and back: one column numbers the parts, the first row of each part describes it.

Numbers are written so that they are read back as they were, times too: between the parts, and at a gap in one of them,
they jump.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.cells import quoted
from stimrig.identify.records.record import Part, Record, Source

CELLS = ("pause_s", "folded_s", "own_s", "begun_s", "pulse_rate_hz", "name", "recording_id", "sha256")
"""Columns of which only a part's first row is filled; all but `pause_s` may be missing or empty."""
LARGEST_UNIX_S = 1e11
LONGEST_TEXT = 300
FIX = "Join the recordings again."


def write(record: Record, path: Path) -> None:
    """Write a record with its parts as CSV (docs/recording.md).

    Raises
    ------
    BadRecord
        The file would be larger than what can be read.
    """
    names = [_cell(name) for name in record.segment_names]
    header = ("time_s", "pulse_width_us", "torque_nm", "segment", *record.columns(), "part", *CELLS)
    numbers = (record.time_s, record.pulse_width_us, record.torque_nm, *record.columns().values())
    columns: list[Iterator[str]] = [map(repr, np.asarray(column, float).tolist()) for column in numbers]
    columns.insert(3, (names[index] for index in record.segment.tolist()))
    columns.append(map(str, record.part.tolist()))
    empty = "," * len(CELLS)
    described = {part.first: "," + cells for part, cells in zip(record.parts, _descriptions(record), strict=True)}
    size = 0
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(header) + "\n")
        for index, row in enumerate(zip(*columns, strict=True)):
            size += file.write(",".join(row) + described.get(index, empty) + "\n")
            if size > bounds.LARGEST_FILE_BYTES:
                message = f"more than {bounds.LARGEST_FILE_BYTES // 2**20} MB as a file"
                raise BadRecord(message, fix="Join fewer recordings.")


def _descriptions(record: Record) -> list[str]:
    """The last cells of each part's first row."""
    alone = len(record.source.parts) != len(record.parts)
    sources = [record.source] * len(record.parts) if alone else record.source.parts
    return [
        ",".join(
            [
                *map(repr, (part.pause_s, part.folded_s, part.own_s)),
                "" if part.begun_s is None else repr(float(part.begun_s)),
                repr(float(record.pulse_rate_hz)),
                *map(_cell, (source.name, source.recording_id, source.sha256)),
            ]
        )
        for part, source in zip(record.parts, sources, strict=True)
    ]


def _cell(text: str) -> str:
    """A text as a cell, without what cannot be printed."""
    return quoted("".join(sign for sign in text if sign.isprintable())[:LONGEST_TEXT])


@dataclass(frozen=True)
class Parts:
    """What a file says of its parts."""

    parts: tuple[Part, ...]
    sources: tuple[Source, ...]
    pulse_rate_hz: float | None


def parsed(
    columns: Mapping[str, np.ndarray], cells: Mapping[int, Mapping[str, str]], lines: Sequence[int], name: str
) -> Parts:
    """The parts of a file from its columns `part` and `time_s` and the cells of each part's first row, by row.

    Raises
    ------
    BadRecord
        Parts are not numbered 0, 1, 2…, time does not rise, or a cell is not what it must be.
    """
    time_s, found = columns["time_s"], []
    _check_time(time_s, list(cells), lines, name)
    for number, (row, texts) in enumerate(cells.items()):

        def at(column: str, row: int = row) -> str:
            return f"{name}, line {lines[row]}, column {column}"

        if columns["part"][row] != number:
            raise BadRecord(f"{columns['part'][row]:g} where part {number} begins", place=at("part"), fix=FIX)
        found.append(_part(row, texts, float(time_s[row]), at))
        gap_s = time_s[row] - time_s[row - 1] if number else 0.0
        if found[-1][0].folded_s > gap_s + 1e-6:
            raise BadRecord("longer than the jump of the time", place=at("folded_s"), fix=FIX)
    rates = {rate for *_, rate in found}
    if len(rates) > 1:
        raise BadRecord("parts of different pulse rates", place=f"{name}, column pulse_rate_hz", fix=FIX)
    return Parts(tuple(part for part, *_ in found), tuple(source for _, source, _ in found), rates.pop())


def _check_time(time_s: np.ndarray, firsts: Sequence[int], lines: Sequence[int], name: str) -> None:
    """Times are taken as they are written: they must rise, and at a rate that can be used."""
    backwards = np.flatnonzero(~(np.diff(time_s) > 0))
    if backwards.size:
        row = int(backwards[0]) + 1
        place = f"{name}, line {lines[row]}, column time_s"
        raise BadRecord(f"time does not rise at {time_s[row]:g} s", place=place, fix=FIX)
    for row, end in zip(firsts, [*firsts[1:], time_s.size], strict=True):
        place = f"{name}, line {lines[row]}, column time_s"
        if end - row < 2:
            raise BadRecord("a part of one sample", place=place, fix=FIX)
        bounds.check_sampling(1 / float(np.median(np.diff(time_s[row:end]))), place)


def _part(
    row: int, texts: Mapping[str, str], time_s: float, at: Callable[[str], str]
) -> tuple[Part, Source, float | None]:
    def number(column: str, lowest: float, highest: float) -> float | None:
        text = texts.get(column, "")
        if not text:
            return None
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not (text.isascii() and "_" not in text and lowest <= value <= highest):
            raise BadRecord(f"{text[:40]!r} is not {lowest:g} to {highest:g}", place=at(column), fix=FIX)
        return value

    def text(column: str) -> str:
        found = texts.get(column, "")
        if len(found) > LONGEST_TEXT or not found.isprintable():
            raise BadRecord("a name that cannot be", place=at(column), fix=FIX)
        return found

    pause_s = number("pause_s", 0.0, bounds.LONGEST_S)
    if pause_s is None:
        raise BadRecord("empty", place=at("pause_s"), fix="Give the pause before each part, 0 if it isn't known.")
    folded_s, latest_s = number("folded_s", 0.0, pause_s), bounds.LARGEST["time_s"]
    own_s = number("own_s", -latest_s, latest_s)
    rate_hz = number("pulse_rate_hz", *bounds.PULSE_RATES_HZ)
    part = Part(
        first=row,
        own_s=time_s if own_s is None else own_s,
        begun_s=number("begun_s", 0.0, LARGEST_UNIX_S),
        pause_s=pause_s,
        folded_s=pause_s if folded_s is None else folded_s,
    )
    return part, Source(text("name"), text("recording_id"), text("sha256")), rate_hz

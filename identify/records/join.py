"""Several recordings of one muscle as one record, made of parts.

Each part keeps its own samples, offset and noise; what they share is the grid of pulses. Nothing is made up to fill
the pause between two parts: it has no rows, and `Part` says how long it truly was."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.cells import is_number, quoted
from stimrig.identify.records.clock import check_rising, pulse_phase_s
from stimrig.identify.records.record import NEEDED, OPTIONAL, Part, Pulses, Record, Source, joined_source
from stimrig.identify.records.table import Table

CELLS = ("pause_s", "folded_s", "own_s", "begun_s", "pulse_rate_hz", "name", "recording_id", "sha256")
"""Columns of which only a part's first row is filled; `begun_s` may be empty there."""
LONGEST_TEXT = 300
FIX = "Join the recordings again."
PAUSE_S = 5.0
"""Longest pause kept in the time: every pulse interval of it is a row of the grid."""
LEAST_SAMPLES = 2
"""Samples between two pulses from which recordings of different rates are joined."""
SAME_RATE = 0.01
"""Sampling rates that differ by less, as a share, are one nominal rate and two clocks."""
ONLY_IF_SET = ("late_s", "doubted")
"""Columns that a record lacks where all their values are 0."""
RESAMPLED = ("time_s", "torque_nm", "angle_rad", "velocity_rad_s")
"""Columns of which a sample at a lower rate is a mean; a flag is set if one was, and else a value is taken that was."""


def write_joined(record: Record, path: Path) -> None:
    """Write a record with its parts as CSV (docs/recording.md).

    Raises BadRecord: the file would be larger than what can be read.
    """
    names = [_cell(name) for name in record.segment_names]
    header = (*NEEDED, "segment", *record.columns(), "part", *CELLS)
    columns = [map(repr, np.asarray(column, float).tolist()) for column in record.samples().values()]
    segments = (names[index] for index in record.segment.tolist())
    rows = zip(*columns[: len(NEEDED)], segments, *columns[len(NEEDED) :], map(str, record.part.tolist()), strict=True)
    described = {}
    for part, source in zip(record.parts, record.sources, strict=True):
        begun_s = "" if part.begun_s is None else repr(float(part.begun_s))
        times_s, rate_hz = map(repr, (part.pause_s, part.folded_s, part.own_s)), repr(float(record.pulse_rate_hz))
        texts = map(_cell, (source.name, source.recording_id, source.sha256))
        described[part.first] = (*times_s, begun_s, rate_hz, *texts)
    size = 0
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(header) + "\n")
        for index, row in enumerate(rows):
            size += file.write(",".join((*row, *described.get(index, ("",) * len(CELLS)))) + "\n")
            if size > bounds.LARGEST_FILE_BYTES:
                message = f"more than {bounds.LARGEST_FILE_BYTES // 2**20} MB as a file"
                raise BadRecord(message, fix="Join fewer recordings.")


def _cell(text: str) -> str:
    """A text as a cell, without what cannot be printed."""
    return quoted("".join(sign for sign in text if sign.isprintable())[:LONGEST_TEXT])


def record_of_parts(table: Table) -> Record:
    """The record of a table that `write_joined` wrote. Times are taken as they are written.

    Raises BadRecord: parts are not numbered 0, 1, 2…, time does not rise, or a cell is not what it must be.
    """
    check_rising(table)
    time_s, firsts = table.columns["time_s"], list(table.part_cells)
    parts, sources = [], []
    for number, (row, end) in enumerate(zip(firsts, [*firsts[1:], time_s.size], strict=True)):
        if end - row < 2:
            raise table.bad("a part of one sample", FIX, row)
        bounds.check_sampling(1 / float(np.median(np.diff(time_s[row:end]))), table.at(row))
        part, source = _part(table, number, row, table.part_cells[row])
        parts.append(part)
        sources.append(source)
    source = joined_source(sources, table.source.name, table.source.sha256)
    columns = {name: column for name, column in table.columns.items() if name != "part"}
    return replace(table, columns=columns, source=replace(source, notes=table.source.notes)).record(parts)


def _part(table: Table, number: int, row: int, cells: Mapping[str, str]) -> tuple[Part, Source]:

    def figure(column: str, lowest: float, highest: float) -> float:
        text = cells.get(column, "")
        value = float(text) if is_number(text) else np.nan
        if not lowest <= value <= highest:
            raise table.bad(f"{text[:40]!r} is not {lowest:g} to {highest:g}", FIX, row, column)
        return value

    def text(column: str) -> str:
        cell = cells.get(column, "")
        if len(cell) > LONGEST_TEXT or not cell.isprintable():
            raise table.bad("a name that cannot be", FIX, row, column)
        return cell

    time_s, part = table.columns["time_s"], table.columns["part"]
    if part[row] != number:
        raise table.bad(f"{part[row]:g} where part {number} begins", FIX, row, "part")
    pause_s = figure("pause_s", 0.0, bounds.LONGEST_S)
    folded_s, latest_s = figure("folded_s", 0.0, pause_s), bounds.LARGEST["time_s"]
    if folded_s > (time_s[row] - time_s[row - 1] if number else 0.0) + 1e-6:
        raise table.bad("longer than the jump of the time", FIX, row, "folded_s")
    begun_s = figure("begun_s", 0.0, bounds.LARGEST_CALENDAR_S) if cells.get("begun_s") else None
    source = Source(text("name"), text("recording_id"), text("sha256"))
    return Part(row, figure("own_s", -latest_s, latest_s), begun_s, pause_s, folded_s), source


class _Piece(NamedTuple):
    """One part, cut out: a record of one part on its own clock, whose pause is that before it in the record that it was
    cut from; and a time at which a pulse is due."""

    record: Record
    slot_s: float

    @property
    def begin_s(self) -> float | None:
        """Its first sample as Unix time, where that is known."""
        begun_s = self.record.parts[0].begun_s
        return None if begun_s is None else begun_s + float(self.record.time_s[0])

    def intervals(self) -> np.ndarray:
        """Pulse intervals from the slot to each sample, in which times may be early by a hair, as on the grid."""
        rate_hz = self.record.pulse_rate_hz
        hair = 1e-6 + 1e-3 * min(1.0, rate_hz / self.record.sample_rate_hz)
        return (self.record.time_s - self.slot_s) * rate_hz + hair

    def order(self) -> tuple[float | None, str, str, bytes]:
        """By when it began; and by what it is, so that either order of arguments gives the same record."""
        source = self.record.source
        return self.begin_s, source.sha256, source.recording_id, self.record.torque_nm.tobytes()


def join(records: Sequence[Record], begun_s: Sequence[float | None]) -> Record:
    """Put records one behind the other as the parts of one.

    `begun_s`: Unix time at which each record's clock was 0; None where it is not known, and for a joined record, which
    is taken apart and knows it of its parts. Where all begins are known the parts are in their order, else as given.

    Parts sampled faster than the slowest are brought down by block means, whole blocks to a pulse interval. Those
    that differ by less than 1 % stay as they are. The slots of the pulses fall on one grid. A pause is kept in whole
    pulse intervals, up to 5 s of it in `time_s`; it is 0 where a begin is not known, or where by their clocks two
    parts overlap. An angle or velocity is dropped unless all parts have it; so are the pulses in the gaps, which are
    doubted then. In a part without `late_s` or `doubted` they are 0.

    Raises BadRecord: pulse rates differ, too little in one or too much together, fewer than two samples a pulse in a
    slow part; the same measurement twice, whose noise would count as that of two.
    """
    if len(records) != len(begun_s) or not records:
        raise BadRecord(f"{len(records)} records with {len(begun_s)} begins", fix="Give one for each.")
    rate_hz = records[0].pulse_rate_hz
    pieces: list[_Piece] = []
    known: set[bytes] = set()
    for number, (record, begun) in enumerate(zip(records, begun_s, strict=True), start=1):
        place = f"recording {number}"
        if abs(record.pulse_rate_hz - rate_hz) > 1e-6:
            message = f"{record.pulse_rate_hz:g} pulses/s, the first has {rate_hz:g}"
            raise BadRecord(message, place=place, fix="Join recordings of one pulse rate.")
        bounds.check_size(record.time_s.size, place)
        for piece in _pieces(record, begun):
            torque_nm = piece.record.torque_nm
            content = hashlib.sha256(torque_nm.tobytes() + piece.record.pulse_width_us.tobytes()).digest()
            if content in known and np.ptp(torque_nm) > 0:  # a copy, or a part of a joined record
                message = "what it holds was measured in another of these recordings, too"
                fix = "Name each recording once, and none beside a joined one with it."
                raise BadRecord(message, place=place, fix=fix)
            known.add(content)
            pieces.append(piece)
    if len(pieces) > bounds.MOST_PARTS:
        raise BadRecord(f"{len(pieces)} parts", fix=f"Join at most {bounds.MOST_PARTS}.")
    if all(piece.begin_s is not None for piece in pieces):
        pieces.sort(key=_Piece.order)
    return _joined(_at_one_rate(pieces, rate_hz), rate_hz)


def _pieces(record: Record, begun_s: float | None) -> list[_Piece]:
    """The parts of a record, each on its own clock."""
    slot_s = float(record.time_s[0]) + pulse_phase_s(record)
    pieces = []
    for index, (part, source) in enumerate(zip(record.parts, record.sources, strict=True)):
        shift_s = part.own_s - float(record.time_s[part.first])
        if len(record.parts) == 1 and part.begun_s is None:
            shift_s, part = 0.0, Part(begun_s=begun_s)  # a plain record's clock is its own
        pulses = None if record.pulses is None else _pulses(record.pulses, shift_s, -np.inf, np.inf)
        cut = record.take(record.part == index)
        parts = (Part(begun_s=part.begun_s, pause_s=part.pause_s if index else 0.0),)
        cut = replace(cut, time_s=cut.time_s + shift_s, pulses=pulses, source=source, parts=parts)
        pieces.append(_Piece(cut, slot_s + shift_s))
    return pieces


def samples_between(sample_rate_hz: float, pulse_rate_hz: float) -> int:
    """Whole samples between two pulses, as far as rates are known."""
    return math.floor((1 + SAME_RATE) * sample_rate_hz / pulse_rate_hz)


def _at_one_rate(pieces: list[_Piece], rate_hz: float) -> list[_Piece]:
    """All pieces at the lowest of their rates, or just below it, where a whole number of samples is to make a pulse."""
    rates_hz = [piece.record.sample_rate_hz for piece in pieces]
    same_hz = (1 + SAME_RATE) * min(rates_hz)
    if max(rates_hz) <= same_hz:
        return pieces
    each = samples_between(min(rates_hz), rate_hz)
    if each < LEAST_SAMPLES:
        fix = f"Recordings of different rates are joined from {LEAST_SAMPLES * rate_hz:g} Hz on."
        raise BadRecord(f"sampled at {min(rates_hz):.4g} and {max(rates_hz):.4g} Hz", fix=fix)
    return [
        piece._replace(record=_block_means(piece, each)) if own_hz > same_hz else piece
        for piece, own_hz in zip(pieces, rates_hz, strict=True)
    ]


def _block_means(piece: _Piece, each: int) -> Record:
    """A piece with `each` samples a pulse interval, at the mean time of what each one is the mean of.

    A block at an edge or a gap, with less than half of its samples, is left out: it would be noisier than the rest.
    A block with any held-out sample is held out.
    """
    record, held_out = piece.record, piece.record.held_out
    block = np.floor(piece.intervals() * each).astype(np.int64)
    starts = np.flatnonzero(np.r_[True, np.diff(block) > 0])
    count = np.diff(np.r_[starts, block.size])
    whole = 2 * count >= np.median(count)
    first_held = np.minimum.reduceat(np.where(held_out, np.arange(block.size), block.size), starts)
    pick = starts + count // 2
    pick = np.where((first_held < block.size) & ~held_out[pick], first_held, pick)[whole]
    changes: dict[str, object] = {}
    for name, column in record.samples().items():
        if name in RESAMPLED:
            changes[name] = (np.add.reduceat(column, starts) / count)[whole]
        elif column.dtype == bool:
            changes[name] = np.logical_or.reduceat(column, starts)[whole]
        else:
            changes[name] = column[pick]
    used, segment = np.unique(record.segment[pick], return_inverse=True)
    names = tuple(record.segment_names[index] for index in used)
    return replace(record, segment=segment, segment_names=names, **changes)  # type: ignore


def _joined(pieces: list[_Piece], rate_hz: float) -> Record:
    total = sum(piece.record.time_s.size for piece in pieces)
    if total > bounds.LARGEST_ROWS:
        raise BadRecord(f"{total} samples together", fix=f"At most {bounds.LARGEST_ROWS} in one record.")
    moved: list[Record] = []
    parts: list[Part] = []
    first, ended, slot_s = 0, 0, pieces[0].slot_s
    for index, piece in enumerate(pieces):
        time_s, pulses = piece.record.time_s, piece.record.pulses
        first_interval, last_interval = np.floor(piece.intervals()[[0, -1]]).astype(int).tolist()
        pause = _pause(pieces[index - 1], piece, rate_hz) if index else 0
        folded = min(pause, round(PAUSE_S * rate_hz))
        start = ended + 1 + folded if index else first_interval
        shift_s = slot_s + (start - first_interval) / rate_hz - piece.slot_s
        ended = start + last_interval - first_interval
        pulses = None if pulses is None else _pulses(pulses, shift_s, float(time_s[0]), float(time_s[-1]))
        moved.append(replace(piece.record, time_s=time_s + shift_s, pulses=pulses))
        parts.append(Part(first, float(time_s[0]), piece.record.parts[0].begun_s, pause / rate_hz, folded / rate_hz))
        first += time_s.size
    columns: dict[str, np.ndarray] = {}
    for name in (*NEEDED, *OPTIONAL):
        each = [getattr(record, name) for record in moved]
        if name in ONLY_IF_SET and any(column is not None and column.any() for column in each):
            nothing = [np.zeros(record.time_s.size, bool if name == "doubted" else float) for record in moved]
            known = [zeros if column is None else column for column, zeros in zip(each, nothing, strict=True)]
            columns[name] = np.concatenate(known)
        elif name not in ONLY_IF_SET and all(column is not None for column in each):
            columns[name] = np.concatenate(each)
    bounds.check_span(columns["time_s"], "the joined record")
    pulses = [record.pulses for record in moved if record.pulses is not None]
    before = np.cumsum([0, *(len(record.segment_names) for record in moved)])
    sources = [record.source for record in moved]
    return Record(
        segment=np.concatenate([record.segment + offset for record, offset in zip(moved, before, strict=False)]),
        segment_names=tuple(name for record in moved for name in record.segment_names),
        pulses=Pulses(*(np.concatenate([getattr(part, field.name) for part in pulses]) for field in fields(Pulses)))
        if len(pulses) == len(moved)
        else None,
        pulse_rate_hz=rate_hz,
        source=sources[0] if len(sources) == 1 else joined_source(sources),
        parts=tuple(parts),
        **columns,  # type: ignore
    )


def _pulses(known: Pulses, shift_s: float, first_s: float, last_s: float) -> Pulses:
    """Those from the first to the last of a part's samples, on another clock."""
    rows = (known.time_s >= first_s) & (known.time_s <= last_s)
    return Pulses(known.time_s[rows] + shift_s, known.width_us[rows], known.late_s[rows], known.lost[rows])


def _pause(before: _Piece, after: _Piece, rate_hz: float) -> int:
    """Whole pulse intervals without a sample between two pieces."""
    pause_s = after.record.parts[0].pause_s
    if before.begin_s is not None and after.begin_s is not None:
        duration_s = float(before.record.time_s[-1] - before.record.time_s[0])
        pause_s = after.begin_s - before.begin_s - duration_s - 1 / before.record.sample_rate_hz
    return round(min(max(pause_s, 0.0), bounds.LONGEST_S) * rate_hz)

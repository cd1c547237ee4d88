"""Several recordings of one muscle as one record, made of parts.

Each part keeps its own samples, offset and noise; what they share is the grid of pulses. Nothing is made up to fill
the pause between two parts: it has no rows, and `Part` says how long it truly was."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.cells import is_number, quoted
from stimrig.identify.records.clock import pulse_phase_s
from stimrig.identify.records.file_content import PULSE_RATE_HZ, FileContent, check_widths
from stimrig.identify.records.record import NEEDED, OPTIONAL, Part, Pulses, Record, Source, joined_source

CELLS = ("pause_s", "folded_s", "own_s", "begun_s", "pulse_rate_hz", "name", "recording_id", "sha256")
"""Columns of which only a part's first row is filled; all but `pause_s` may be missing or empty."""
LONGEST_TEXT = 300
FIX = "Join the recordings again."


def write_joined(record: Record, path: Path) -> None:
    """Write a record with its parts as CSV (docs/recording.md).

    Raises BadRecord: the file would be larger than what can be read.
    """
    names = [_cell(name) for name in record.segment_names]
    header = (*NEEDED, "segment", *record.columns(), "part", *CELLS)
    numbers = (np.asarray(column, float).tolist() for column in record.samples().values())
    columns: list[Iterator[str]] = [map(repr, column) for column in numbers]
    columns.insert(len(NEEDED), (names[index] for index in record.segment.tolist()))
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
    return [
        ",".join(
            [
                *map(repr, (part.pause_s, part.folded_s, part.own_s)),
                "" if part.begun_s is None else repr(float(part.begun_s)),
                repr(float(record.pulse_rate_hz)),
                *map(_cell, (source.name, source.recording_id, source.sha256)),
            ]
        )
        for part, source in zip(record.parts, record.sources, strict=True)
    ]


def _cell(text: str) -> str:
    """A text as a cell, without what cannot be printed."""
    return quoted("".join(sign for sign in text if sign.isprintable())[:LONGEST_TEXT])


def read_joined(file: FileContent, cells: Mapping[int, Mapping[str, str]], pulse_rate_hz: float | None) -> Record:
    """The record of a file with the column `part` and the `cells` of each part's first row, by row.

    Times are taken as they are written. Raises BadRecord: parts are not numbered 0, 1, 2…, time does not rise, or a
    cell is not what it must be.
    """
    for column, values in file.columns.items():
        if column != "segment" and (bad := np.flatnonzero(~(np.abs(values) <= bounds.LARGEST[column]))).size:
            place = file.at(int(bad[0]), column)
            raise BadRecord(f"{values[bad[0]]:g} is no measurement", place=place, fix=FIX)
    check_widths(file)
    _check_time(file, list(cells))
    described = (_part(file, number, *cell) for number, cell in enumerate(cells.items()))
    parts, sources, rates = zip(*described, strict=True)
    if len(set(rates)) > 1:
        raise BadRecord("parts of different pulse rates", place=f"{file.name}, column pulse_rate_hz", fix=FIX)
    time_s = file.columns["time_s"]
    bounds.check_span(time_s, file.at(time_s.size - 1))
    source = joined_source(sources, file.source.name, file.source.sha256)
    return replace(
        file,
        columns={name: column for name, column in file.columns.items() if name != "part"},
        source=replace(source, notes=file.source.notes),
        pulse_rate_hz=pulse_rate_hz or rates[0] or PULSE_RATE_HZ,
    ).record(parts=parts)


def _check_time(file: FileContent, firsts: Sequence[int]) -> None:
    """Times must rise, and at a rate that can be used."""
    time_s = file.columns["time_s"]
    backwards = np.flatnonzero(~(np.diff(time_s) > 0))
    if backwards.size:
        row = int(backwards[0]) + 1
        raise BadRecord(f"time does not rise at {time_s[row]:g} s", place=file.at(row), fix=FIX)
    for row, end in zip(firsts, [*firsts[1:], time_s.size], strict=True):
        if end - row < 2:
            raise BadRecord("a part of one sample", place=file.at(row), fix=FIX)
        bounds.check_sampling(1 / float(np.median(np.diff(time_s[row:end]))), file.at(row))


def _part(file: FileContent, number: int, row: int, texts: Mapping[str, str]) -> tuple[Part, Source, float | None]:
    """A part, its source and its pulse rate from the cells of its first row."""

    def figure(column: str, lowest: float, highest: float) -> float | None:
        text = texts.get(column, "")
        if not text:
            return None
        value = float(text) if is_number(text) else np.nan
        if not lowest <= value <= highest:
            message = f"{text[:40]!r} is not {lowest:g} to {highest:g}"
            raise BadRecord(message, place=file.at(row, column), fix=FIX)
        return value

    def text(column: str) -> str:
        cell = texts.get(column, "")
        if len(cell) > LONGEST_TEXT or not cell.isprintable():
            raise BadRecord("a name that cannot be", place=file.at(row, column), fix=FIX)
        return cell

    time_s, part = file.columns["time_s"], file.columns["part"]
    if part[row] != number:
        raise BadRecord(f"{part[row]:g} where part {number} begins", place=file.at(row, "part"), fix=FIX)
    pause_s = figure("pause_s", 0.0, bounds.LONGEST_S)
    if pause_s is None:
        fix = "Give the pause before each part, 0 if it isn't known."
        raise BadRecord("empty", place=file.at(row, "pause_s"), fix=fix)
    folded_s, latest_s = figure("folded_s", 0.0, pause_s), bounds.LARGEST["time_s"]
    folded_s = pause_s if folded_s is None else folded_s
    own_s = figure("own_s", -latest_s, latest_s)
    own_s = float(time_s[row]) if own_s is None else own_s
    rate_hz = figure("pulse_rate_hz", *bounds.PULSE_RATES_HZ)
    begun_s = figure("begun_s", 0.0, bounds.LARGEST_CALENDAR_S)
    source = Source(text("name"), text("recording_id"), text("sha256"))
    if folded_s > (time_s[row] - time_s[row - 1] if number else 0.0) + 1e-6:
        raise BadRecord("longer than the jump of the time", place=file.at(row, "folded_s"), fix=FIX)
    return Part(row, own_s, begun_s, pause_s, folded_s), source, rate_hz


PAUSE_S = 30.0
"""Longest pause kept in the time: every pulse interval of it is a row of the grid."""
LEAST_SAMPLES = 2
"""Samples between two pulses from which recordings of different rates are joined."""
SAME_RATE = 0.01
"""Sampling rates that differ by less, as a share, are one nominal rate and two clocks."""
ONLY_IF_SET = ("late_s", "doubted")
"""Columns that a record lacks where all their values are 0."""
RESAMPLED = ("time_s", "torque_nm", "angle_rad", "velocity_rad_s")
"""Columns of which a sample at a lower rate is a mean; a flag is set if one was, and else a value is taken that was."""


@dataclass(frozen=True)
class _Piece:
    """One part, cut out: a record on its own clock."""

    record: Record
    begun_s: float | None
    slot_s: float
    """A time at which a pulse is due."""
    source: Source
    known_pause_s: float
    """The pause before it in the record that it was cut from; 0 for that one's first."""

    @property
    def begin_s(self) -> float:
        """Its first sample as Unix time."""
        assert self.begun_s is not None
        return self.begun_s + float(self.record.time_s[0])

    def interval(self, index: int, rate_hz: float) -> int:
        """The pulse interval of a sample, counted from the slot; a hair early, as on the grid."""
        intervals = (float(self.record.time_s[index]) - self.slot_s) * rate_hz
        return math.floor(intervals + 1e-6 + 1e-3 * min(1.0, rate_hz / self.record.sample_rate_hz))


def join(records: Sequence[Record], begun_s: Sequence[float | None]) -> Record:
    """Put records one behind the other as the parts of one.

    Where all begins are known the parts are in their order, else as given; either order of the arguments then gives
    the same record. A record that was joined before is taken apart: its parts stand beside the others'.

    Parts sampled faster than the slowest are brought down by block means, whole blocks to a pulse interval. Those
    that differ by less than 1 % stay as they are. The slots of the pulses fall on one grid. A pause is kept in whole
    pulse intervals, up to 30 s of it in `time_s`; it is 0 where a begin is not known, or where by their clocks two
    parts overlap. An angle or velocity is dropped unless all parts have it; so are the pulses in the gaps, which are
    doubted then. In a part without `late_s` or `doubted` they are 0.

    Parameters
    ----------
    records : sequence of Record
        At least one.
    begun_s : sequence of float or None
        Unix time at which each record's clock was 0; None where it is not known, and for a joined record, which knows
        it of its parts.

    Raises
    ------
    BadRecord
        Pulse rates differ, too little in one or too much together, fewer than two samples a pulse in a slow part.
        The same measurement twice: its noise would count as that of two.
    """
    if len(records) != len(begun_s) or not records:
        raise BadRecord(f"{len(records)} records with {len(begun_s)} begins", fix="Give one for each.")
    rate_hz = records[0].pulse_rate_hz
    pieces: list[_Piece] = []
    known: set[bytes] = set()
    for number, (record, begun) in enumerate(zip(records, begun_s, strict=True), start=1):
        if abs(record.pulse_rate_hz - rate_hz) > 1e-6:
            message = f"{record.pulse_rate_hz:g} pulses/s, the first has {rate_hz:g}"
            raise BadRecord(message, place=f"recording {number}", fix="Join recordings of one pulse rate.")
        bounds.check_size(record.time_s.size, f"recording {number}")
        record_pieces = _pieces(record, begun)
        _refuse_twice(record_pieces, known, f"recording {number}")
        pieces += record_pieces
    if len(pieces) > bounds.MOST_PARTS:
        raise BadRecord(f"{len(pieces)} parts", fix=f"Join at most {bounds.MOST_PARTS}.")
    if all(piece.begun_s is not None for piece in pieces):
        pieces.sort(key=_order)
    return _joined(_at_one_rate(pieces, rate_hz), rate_hz)


def _refuse_twice(pieces: Sequence[_Piece], known: set[bytes], place: str) -> None:
    """Refuse a measurement that is there already, under whatever name: a copy, or a part of a joined record."""
    for piece in pieces:
        torque_nm = piece.record.torque_nm
        content = hashlib.sha256(torque_nm.tobytes() + piece.record.pulse_width_us.tobytes()).digest()
        if content in known and np.ptp(torque_nm) > 0:
            message = "what it holds was measured in another of these recordings, too"
            raise BadRecord(message, place=place, fix="Name each recording once, and none beside a joined one with it.")
        known.add(content)


def _order(piece: _Piece) -> tuple[float, str, str, bytes]:
    return piece.begin_s, piece.source.sha256, piece.source.recording_id, piece.record.torque_nm.tobytes()


def _pieces(record: Record, begun_s: float | None) -> list[_Piece]:
    """The parts of a record, each on its own clock."""
    slot_s = float(record.time_s[0]) + pulse_phase_s(record)
    alone = len(record.parts) == 1
    edges = [*(part.first for part in record.parts), record.time_s.size]
    pieces = []
    for index, (part, source) in enumerate(zip(record.parts, record.sources, strict=True)):
        # A plain record's clock is its own.
        shift_s = 0.0 if alone and part.begun_s is None else part.own_s - float(record.time_s[part.first])
        pulses = None if record.pulses is None else _pulses(record.pulses, shift_s, -np.inf, np.inf)
        cut = record.take(np.arange(part.first, edges[index + 1]))
        pieces.append(
            _Piece(
                record=replace(cut, time_s=cut.time_s + shift_s, pulses=pulses, parts=(Part(),)),
                begun_s=begun_s if alone and part.begun_s is None else part.begun_s,
                slot_s=slot_s + shift_s,
                source=source,
                known_pause_s=part.pause_s if index else 0.0,
            )
        )
    return pieces


def samples_between(sample_rate_hz: float, pulse_rate_hz: float) -> int:
    """Whole samples between two pulses, as far as rates are known."""
    return math.floor((1 + SAME_RATE) * sample_rate_hz / pulse_rate_hz)


def _at_one_rate(pieces: list[_Piece], rate_hz: float) -> list[_Piece]:
    """All pieces at the lowest of their rates, or just below it, where a whole number of samples is to make a pulse."""
    rates_hz = [piece.record.sample_rate_hz for piece in pieces]
    lowest = min(rates_hz)
    if max(rates_hz) <= (1 + SAME_RATE) * lowest:
        return pieces
    each = samples_between(lowest, rate_hz)
    if each < LEAST_SAMPLES:
        fix = f"Recordings of different rates are joined from {LEAST_SAMPLES * rate_hz:g} Hz on."
        raise BadRecord(f"sampled at {lowest:.4g} and {max(rates_hz):.4g} Hz", fix=fix)
    return [
        replace(piece, record=_block_means(piece, each, rate_hz)) if own_hz > (1 + SAME_RATE) * lowest else piece
        for piece, own_hz in zip(pieces, rates_hz, strict=True)
    ]


def _block_means(piece: _Piece, each: int, rate_hz: float) -> Record:
    """A piece with `each` samples a pulse interval, at the mean time of what each one is the mean of.

    A block at an edge or a gap, with less than half of its samples, is left out: it would be noisier than the rest.
    A block with any held-out sample is held out.
    """
    record = piece.record
    hair = 1e-6 + 1e-3 * min(1.0, rate_hz / record.sample_rate_hz)
    block = np.floor(((record.time_s - piece.slot_s) * rate_hz + hair) * each).astype(np.int64)
    starts = np.flatnonzero(np.r_[True, np.diff(block) > 0])
    count = np.diff(np.r_[starts, block.size])
    whole = 2 * count >= np.median(count)
    pick = starts + count // 2
    any_held_out = np.add.reduceat(record.held_out.astype(np.int64), starts) > 0
    for index in np.flatnonzero(any_held_out & ~record.held_out[pick]):
        pick[index] = starts[index] + int(np.argmax(record.held_out[starts[index] : starts[index] + count[index]]))
    pick = pick[whole]
    changes: dict[str, object] = {}
    for name, column in record.samples().items():
        if name in RESAMPLED:
            changes[name] = (np.add.reduceat(column, starts) / count)[whole]
        elif column.dtype == bool:
            changes[name] = np.logical_or.reduceat(column, starts)[whole]
        else:
            changes[name] = column[pick]
    picked_segment = record.segment[pick]
    used, segment = np.unique(picked_segment, return_inverse=True)
    names = tuple(record.segment_names[index] for index in used)
    return replace(record, segment=segment, segment_names=names, **changes)  # type: ignore


def _joined(pieces: list[_Piece], rate_hz: float) -> Record:
    """One record of pieces at one rate."""
    total = sum(piece.record.time_s.size for piece in pieces)
    if total > bounds.LARGEST_ROWS:
        raise BadRecord(f"{total} samples together", fix=f"At most {bounds.LARGEST_ROWS} in one record.")
    moved, parts, codes, names, sources = [], [], [], [], []
    pulses: list[Pulses] = []
    first, ended, slot_s = 0, 0, pieces[0].slot_s
    for index, piece in enumerate(pieces):
        time_s = piece.record.time_s
        first_interval = piece.interval(0, rate_hz)
        pause = _pause(pieces[index - 1], piece, rate_hz) if index else 0
        folded = min(pause, round(PAUSE_S * rate_hz))
        start = ended + 1 + folded if index else first_interval
        shift_s = slot_s + (start - first_interval) / rate_hz - piece.slot_s
        ended = start + piece.interval(-1, rate_hz) - first_interval
        moved.append(replace(piece.record, time_s=time_s + shift_s))
        if piece.record.pulses is not None:
            pulses.append(_pulses(piece.record.pulses, shift_s, float(time_s[0]), float(time_s[-1])))
        codes.append(piece.record.segment + len(names))
        names += piece.record.segment_names
        sources.append(piece.source)
        parts.append(Part(first, float(time_s[0]), piece.begun_s, pause / rate_hz, folded / rate_hz))
        first += time_s.size
    columns: dict[str, np.ndarray] = {}
    for name in (*NEEDED, *OPTIONAL):
        each = [column for record in moved if (column := _column(record, name)) is not None]
        if len(each) == len(pieces) and (name not in ONLY_IF_SET or any(column.any() for column in each)):
            columns[name] = np.concatenate(each)
    bounds.check_span(columns["time_s"], "the joined record")
    return Record(
        segment=np.concatenate(codes),
        segment_names=tuple(names),
        pulses=_all_pulses(pulses) if len(pulses) == len(pieces) else None,
        pulse_rate_hz=rate_hz,
        source=sources[0] if len(sources) == 1 else joined_source(sources),
        parts=tuple(parts),
        **columns,  # type: ignore
    )


def _column(record: Record, name: str) -> np.ndarray | None:
    column = getattr(record, name)
    if column is None and name in ONLY_IF_SET:
        return np.zeros(record.time_s.size, bool if name == "doubted" else float)
    return column


def _pulses(known: Pulses, shift_s: float, first_s: float, last_s: float) -> Pulses:
    """Those from the first to the last of a part's samples, on another clock."""
    rows = (known.time_s >= first_s) & (known.time_s <= last_s)
    return Pulses(known.time_s[rows] + shift_s, known.width_us[rows], known.late_s[rows], known.lost[rows])


def _all_pulses(parts: list[Pulses]) -> Pulses:
    columns = (np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Pulses))
    return Pulses(*columns)


def _pause(before: _Piece, after: _Piece, rate_hz: float) -> int:
    """Whole pulse intervals without a sample between two pieces."""
    if before.begun_s is not None and after.begun_s is not None:
        last_s = before.begun_s + float(before.record.time_s[-1])
        pause_s = after.begin_s - last_s - 1 / before.record.sample_rate_hz
    else:
        pause_s = after.known_pause_s
    return round(min(max(pause_s, 0.0), bounds.LONGEST_S) * rate_hz)

"""A record from a table of text, as the rig or another tool wrote it (docs/recording.md).

It is read in blocks of rows, so that memory follows the numbers it holds and not what else is in the file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds, columns, parts_csv, text
from stimrig.identify.records.assemble import PULSE_RATE_HZ, Found, check_widths, optional, record_of
from stimrig.identify.records.columns import Column, Given
from stimrig.identify.records.record import Record, Source, joined_source
from stimrig.identify.records.table import Table


def read_csv(content: bytes, path: Path, pulse_rate_hz: float | None = None, given: Given | None = None) -> Record:
    """A record of a table from its bytes; `path` is how it is called, `given` what `--map` says.

    Pulses come at 40 Hz, unless it or the caller says else.

    Raises
    ------
    BadRecord
        With file, line and column, and what to do.
    """
    name = str(path)
    encoding, encoded = text.encoding_of(content, name)
    layout = text.layout(content, encoding, given or {}, name)
    known = columns.columns(layout.header, given or {}, layout.units, f"{name}, line {layout.line}")
    cells = _cells_of_parts(layout.header, known, f"{name}, line {layout.line}")
    table = Table(name, known, cells, commas=layout.separator != ",")
    table.fill(layout.rows)
    if not table.lines:
        place = f"{name}, line {layout.line + 1}"
        raise BadRecord("no row under the header", place=place, fix="Give a few seconds of data.")
    source = Source(path.name, sha256=hashlib.sha256(content).hexdigest(), notes=_notes(encoded, layout, table, known))
    found = Found(
        columns={column: np.array(values) for column, values in table.numbers.items()},
        segment=np.array(table.segment) if "segment" in known else None,
        names=list(table.names),
        name=name,
        cell=lambda row, column: f"line {table.lines[row]}, column {column}",
        source=source,
        pulse_rate_hz=pulse_rate_hz or PULSE_RATE_HZ,
    )
    return _joined(found, table, pulse_rate_hz) if cells else record_of(found)


def _notes(encoded: str, layout: text.Layout, table: Table, known: Mapping[str, Column]) -> tuple[str, ...]:
    """What was assumed of how the file is written, and of its columns."""
    written = []
    if layout.separator != ",":
        written.append(f"{text.SEPARATORS[layout.separator]} between cells")
    if table.decimal == ",":
        written.append("decimal commas")
    if layout.line != 1:
        written.append(f"header in line {layout.line}" if layout.line else "no header")
    columns = "; ".join(column.note for column in known.values() if column.note)
    return tuple(note for note in (encoded, ", ".join(written), columns) if note)


def _cells_of_parts(header: list[str], known: dict[str, Column], place: str) -> dict[str, int]:
    """Where a joined record describes its parts; `part` joins the known columns then."""
    header = [cell.strip() for cell in header]
    # One of them alone is a column of somebody else's.
    if not {"part", "pause_s", "segment"} <= set(header):
        return {}
    if twice := [column for column in ("part", *parts_csv.CELLS) if header.count(column) > 1]:
        raise BadRecord(f"column {twice[0]} is there twice", place=place, fix="Keep one of them.")
    known["part"] = Column(header.index("part"))
    return {column: header.index(column) for column in parts_csv.CELLS if column in header}


def _joined(found: Found, table: Table, pulse_rate_hz: float | None) -> Record:
    """A record that was joined: its times are taken as they are written."""
    for column, values in found.columns.items():
        if (bad := np.flatnonzero(~(np.abs(values) <= bounds.LARGEST[column]))).size:
            place = found.at(int(bad[0]), column)
            raise BadRecord(f"{values[bad[0]]:g} is no measurement", place=place, fix=parts_csv.FIX)
    check_widths(found.columns, found.at)
    time_s = found.columns["time_s"]
    joined = parts_csv.parsed(found.columns, table.parts, table.lines, table.name)
    bounds.check_span(time_s, found.at(time_s.size - 1, "time_s"))
    source = joined_source(joined.sources, found.source.name, found.source.sha256)
    return Record.from_arrays(
        time_s,
        found.columns["pulse_width_us"],
        found.columns["torque_nm"],
        found.segment,
        segment_names=found.names,
        pulse_rate_hz=pulse_rate_hz or joined.pulse_rate_hz or PULSE_RATE_HZ,
        source=replace(source, notes=found.source.notes),
        parts=joined.parts,
        **optional(found.columns),
    )

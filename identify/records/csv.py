"""A record from a table of text, as the rig or another tool wrote it (docs/recording.md).

It is read in blocks of rows, so that memory follows the numbers it holds and not what else is in the file."""

from __future__ import annotations

import codecs
import csv
import io
import re
from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds, columns, join
from stimrig.identify.records.assemble import record_of
from stimrig.identify.records.cells import as_written, is_number
from stimrig.identify.records.columns import Column, ColumnMap
from stimrig.identify.records.file_content import PULSE_RATE_HZ, FileContent, file_source
from stimrig.identify.records.record import Record

LONGEST_LINE = 10_000
"""Characters; no row of numbers has as many."""
MOST_BEFORE = 100
"""Lines before the header at most."""
BLANKS = " "
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", BLANKS: "blanks"}
COMMENTS = ("#", "%", "//")
PACKED = {
    b"\x1f\x8b": ("packed with gzip", "Unpack it with gunzip first."),
    b"PK\x03\x04": ("an Excel workbook or a ZIP archive", "Save the sheet as CSV text, or unpack the archive."),
    b"\xd0\xcf\x11\xe0": ("an old Excel workbook", "Save the sheet as CSV text."),
}
"""First bytes of tables that are not text, with the kind of file and the fix."""
Row = tuple[int, list[str]]


def encoding_of(content: bytes, name: str) -> tuple[str, str]:
    """The codec of a text, and what of it was assumed (empty where the text says it itself).

    Raises BadRecord: no text.
    """
    for start, (what, fix) in PACKED.items():
        if content.startswith(start):
            raise BadRecord(what, place=f"{name}, line 1", fix=fix)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16", ""
    if b"\0" in content:
        head = content[:4096]
        for codec, zeros, signs in (("utf-16-le", head[1::2], head[::2]), ("utf-16-be", head[::2], head[1::2])):
            if zeros.count(0) > 0.9 * len(zeros) and b"\0" not in signs:
                return codec, "read as UTF-16 text"
        place = f"{name}, line {content.count(10, 0, content.index(0)) + 1}"
        raise BadRecord("not text (a zero byte)", place=place, fix="Save the file as CSV text.")
    if content.isascii() or _is_utf8(content):
        return "utf-8-sig", ""
    return "cp1252", "not UTF-8: read as Windows-1252 (Latin-1) text"


def _is_utf8(content: bytes) -> bool:
    pieces = (content[start : start + bounds.PIECE_BYTES] for start in range(0, len(content), bounds.PIECE_BYTES))
    try:
        for _ in codecs.iterdecode(pieces, "utf-8"):
            pass
    except UnicodeDecodeError:
        return False
    return True


def text_lines(content: bytes, encoding: str, name: str) -> Iterator[str]:
    """The file's lines, none too long and not too many.

    Raises BadRecord: too long, too many, or bytes that are no text.
    """
    file = io.TextIOWrapper(io.BytesIO(content), encoding, newline="")
    number = 0
    try:
        for number, line in enumerate(file, start=1):
            if len(line) > LONGEST_LINE:
                fix = "One row a line; is it text at all?"
                raise BadRecord(f"more than {LONGEST_LINE} characters", place=f"{name}, line {number}", fix=fix)
            if number > bounds.LARGEST_ROWS:
                fix = "Cut the record, or resample it to a lower rate."
                raise BadRecord(f"more than {bounds.LARGEST_ROWS} lines", place=f"{name}, line {number}", fix=fix)
            yield line
    except UnicodeDecodeError:
        raise BadRecord("not text", place=f"{name}, line {number + 1}", fix="Save the file as UTF-8 CSV.") from None


@dataclass
class Layout:
    """Separator and header of a table, and its rows from the first one with numbers."""

    separator: str
    header: list[str]
    line: int
    rows: Iterator[Row]
    units: list[str] = field(default_factory=list)


def find_layout(content: bytes, encoding: str, column_map: ColumnMap, name: str) -> Layout:
    """Find header and separator among the first lines.

    Raises BadRecord: no line names the columns that a record needs, or the rows do not stand under it.
    """
    source = text_lines(content, encoding, name)
    before: list[str] = []
    closest: tuple[float, int, list[str]] = (0.0, 1, [])
    for number, line in enumerate(islice(source, MOST_BEFORE + 1), start=1):
        before.append(line)
        for separator in SEPARATORS:
            cells = _cells(line, separator)
            indices_of = columns.places(cells, column_map)
            if number <= MOST_BEFORE and len(cells) >= len(columns.NEEDED) and columns.complete(indices_of):
                if not _numbered(column_map):
                    rows = _rows(source, separator, number + 1, name)
                    return _below(Layout(separator, cells, number, rows), content, name)
                if all(is_number(cells[indices_of[target][0]].replace(",", ".")) for target in columns.NEEDED):
                    return Layout(separator, cells, 0, _rows(chain([line], source), separator, number, name))
            score = len(indices_of) + (0.5 if sum(map(_is_word, cells)) >= 3 else 0)
            if score > closest[0]:
                closest = (score, number, cells)
    raise _no_header(before, closest[1], closest[2], column_map, name)


def _numbered(column_map: ColumnMap) -> bool:
    """Return true if all needed columns are chosen by number, so that no header is needed."""
    return all(target in column_map and column_map[target].name.startswith("#") for target in columns.NEEDED)


def _cells(line: str, separator: str) -> list[str]:
    text = line.strip().lstrip("#%").strip() if line.lstrip()[:1] in ("#", "%") else line.strip("\r\n")
    if separator == BLANKS:
        return re.sub(r"[ \t]+([\[(][^\[\]()]{0,40}[\])])", r"\1", text[:LONGEST_LINE]).split()
    if separator not in text:
        return []
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=separator), [])]
    except csv.Error:
        return []


def _rows(source: Iterable[str], separator: str, first_line: int, name: str) -> Iterator[Row]:
    """Rows with the number of their line; empty lines are passed over."""
    if separator == BLANKS:
        yield from ((number, cells) for number, line in enumerate(source, first_line) if (cells := line.split()))
        return
    reader = csv.reader(source, delimiter=separator)
    before = first_line - 1
    try:
        for row in reader:
            if row:
                yield before + reader.line_num, row
    except csv.Error as error:
        place = f"{name}, line {before + reader.line_num}"
        raise BadRecord(f"not CSV ({error})", place=place, fix="Save the file as comma-separated text.") from error


def _below(layout: Layout, content: bytes, name: str) -> Layout:
    """With the row of units below the header, if there is one, taken off the rows, and comments left out."""
    double = 2 * layout.separator
    if any(f"\n{sign}".encode() in content for sign in (*COMMENTS, double)) or b"\0" in content:
        layout.rows = ((line, row) for line, row in layout.rows if not _is_aside(row))
    layout.rows = _no_wider(layout, layout.rows, name)
    first = next(layout.rows, None)
    if first is None:
        return layout
    line, row = first
    filled = [cell.strip() for cell in row if cell.strip()]
    known = {unit for target in columns.UNITS for unit in columns.UNITS[target]}
    if any(columns.plain_unit(cell) in known for cell in filled) and not any(is_number(cell) for cell in filled):
        layout.units = row
        return layout
    _check_width(layout, line, row, name)
    layout.rows = chain([first], layout.rows)
    return layout


def _is_aside(row: list[str]) -> bool:
    """Return true for a comment or an empty row."""
    return row[0].lstrip().startswith(COMMENTS) or not any(cell.strip() for cell in row)


def _no_wider(layout: Layout, rows: Iterator[Row], name: str) -> Iterator[Row]:
    """The rows; one further down with more cells than the header is refused as the first one is."""
    width = len(layout.header)
    for line, row in rows:
        if len(row) > width and any(cell.strip() for cell in row[width:]):
            _check_width(layout, line, row, name)
        yield line, row


def _check_width(layout: Layout, line: int, row: list[str], name: str) -> None:
    """Refuse rows that have more cells than the header has names: it is not known which cell is which."""
    used = max((index for index, cell in enumerate(row, start=1) if cell.strip()), default=0)
    if used == len(layout.header) or (used < len(layout.header) and used > 1 and layout.separator != BLANKS):
        return
    fix = "Name every column."
    if used < len(layout.header):
        fix = f"The header is separated by {SEPARATORS[layout.separator]}: separate the rows alike."
    elif layout.separator == ",":
        fix = "Name every column; with decimal commas, separate the cells with semicolons."
    message = f"{used} {'cell' if used == 1 else 'cells'} under a header of {len(layout.header)}"
    raise BadRecord(message, place=f"{name}, line {line}", fix=fix)


def _no_header(before: list[str], number: int, cells: list[str], column_map: ColumnMap, name: str) -> BadRecord:
    """Describe what the line that is most like a header lacks."""
    fix = "The first line must be time_s,pulse_width_us,torque_nm,segment, or name your columns with --map."
    if not cells:
        filled = any(line.strip("\ufeff \t\r\n") for line in before)
        if filled and any(is_number(cell) for cell in re.split(r"[,;|\s]+", before[0].strip())[:1]):
            fix = "Say which column is which: --map time_s=#1:s --map pulse_width_us=#2:µs --map torque_nm=#3:Nm."
        return BadRecord("no header" if filled else "empty", place=f"{name}, line 1", fix=fix)
    try:
        columns.columns(cells, column_map, [], f"{name}, line {number}")
    except BadRecord as error:
        return error
    fix = "Put one line with the columns' names before the numbers, or name each column with --map."
    return BadRecord("no numbers follow the header", place=f"{name}, line {number}", fix=fix)


def _is_word(cell: str) -> bool:
    return bool(cell) and not is_number(cell.replace(",", "."))


BLOCK = 4096
CUT = "Every row needs every column; was the file cut off?"
MISSING = {"", "nan", "na", "n/a", "n.a.", "#n/a", "#nv", "null", "none", "-", "--"}
"""Texts that tools write where they have no number."""


class Table:
    """Contents of the rows: numbers by column, segments by name, and each row's line.

    `name`: how messages call the file. `columns`: where each column stands, and its factor; a `segment` may be missing.
    `cells`: where the cells stand that describe a part; empty where the file has none. `commas`: whether numbers may
    have decimal commas: not where commas separate the cells.
    """

    def __init__(self, name: str, columns: Mapping[str, Column], cells: Mapping[str, int], commas: bool) -> None:
        self.name, self.columns, self.cells, self.commas = name, columns, cells, commas
        self.lines = array("L")
        self.segment = array("L")
        self.names: dict[str, int] = {}
        self.numbers = {column: array("d") for column in columns if column != "segment"}
        self.parts: dict[int, dict[str, str]] = {}
        """Cells that describe a part, by the row that it begins with."""
        self.decimal = ""
        """The decimal sign, once one was met."""

    def fill(self, rows: Iterable[Row]) -> None:
        """Take all rows in. Raises BadRecord: with file, line and column."""
        source = iter(rows)
        while block := list(islice(source, BLOCK)):
            for column, values in self.numbers.items():
                values.extend(self._column(block, column))
            if self.cells:
                self._take_parts(block)
            if "segment" in self.columns:
                self._take_segments(block)
            self.lines.extend(line for line, _ in block)

    def _take_segments(self, rows: list[Row]) -> None:
        at = self.columns["segment"].index
        for line, row in rows:
            if len(row) <= at:
                raise self._short(row, line, "segment")
            text = as_written(row[at].strip())
            code = self.names.get(text)
            self.segment.append(self._new_name(text, line) if code is None else code)

    def _take_parts(self, rows: list[Row]) -> None:
        """Keep the cells of each row with which a part begins."""
        before = len(self.lines)
        number = np.array(self.numbers["part"][max(before - 1, 0) :])
        firsts = np.flatnonzero(np.diff(number)) + (0 if before else 1)
        for index in firsts.tolist() if before else [0, *firsts.tolist()]:
            line, row = rows[index]
            if len(row) <= max(self.cells.values()):
                raise self._short(row, line, "pause_s")
            self.parts[before + index] = {column: as_written(row[at].strip()) for column, at in self.cells.items()}
            if len(self.parts) > bounds.MOST_PARTS:
                fix = f"At most {bounds.MOST_PARTS} in one record."
                raise BadRecord("too many parts", place=self.at(line, "part"), fix=fix)

    def _column(self, rows: list[Row], column: str) -> np.ndarray:
        """The numbers of a column in its own unit; NaN where the file has none."""
        source = self.columns[column]
        try:
            cells = [row[source.index] for _, row in rows]
        except IndexError:
            line, row = next((line, row) for line, row in rows if len(row) <= source.index)
            raise self._short(row, line, column) from None
        text = "".join(cells)
        lines = [line for line, _ in rows]
        self._settle_decimal(text, cells, column, lines)
        if self.decimal == ",":
            cells, text = [cell.replace(",", ".") for cell in cells], text.replace(",", ".")
        try:
            values = np.array([float(cell) for cell in cells])
        except ValueError:
            values = np.array([self._number(cell, column, line) for cell, line in zip(cells, lines, strict=True)])
        # Python's float also takes digits of other scripts and underscores, which no measuring tool writes.
        if not text.isascii() or "_" in text:
            for cell, line in zip(cells, lines, strict=True):
                self._number(cell, column, line)
        if source.factor != 1.0:
            values *= source.factor
        if (bad := bounds.wrong_rows(column, values)).size:
            cell_text = columns.short(cells[bad[0]].strip())
            fix = "Remove the row's cause, or cut the record before it; values must be finite."
            fix = bounds.fix_of(column, values[bad], fix)
            message = f"{cell_text} is no measurement" if cell_text else "empty"
            raise BadRecord(message, place=self.at(lines[bad[0]], column), fix=fix)
        return values

    def _settle_decimal(self, text: str, cells: list[str], column: str, lines: list[int]) -> None:
        """One decimal sign for the whole file."""
        for sign in ",.":
            if sign not in text:
                continue
            if (self.commas or sign == ".") and self.decimal in ("", sign):
                self.decimal = sign
                continue
            cell, line = next(pair for pair in zip(cells, lines, strict=True) if sign in pair[0])
            other = f"after numbers with a decimal {'comma' if sign == '.' else 'point'}"
            message = f"{columns.short(cell)!r} {other if self.decimal else 'between separating commas'}"
            fix = "Write all numbers with a decimal point, without signs between thousands."
            raise BadRecord(message, place=self.at(line, column), fix=fix)

    def _number(self, cell: str, column: str, line: int) -> float:
        """One number; NaN where the tool says that it has none."""
        if cell.strip().lower() in MISSING:
            return np.nan
        if is_number(cell):
            return float(cell)
        fix = "Give a number with a decimal point, without signs between thousands."
        raise BadRecord(f"{columns.short(cell)!r} is no number", place=self.at(line, column), fix=fix)

    def _new_name(self, text: str, line: int) -> int:
        bounds.check_name(text, self.at(line, "segment"))
        if len(self.names) == bounds.MOST_SEGMENTS:
            fix = "Name segments by what they are (rest, prbs…), not each row."
            raise BadRecord(f"more than {bounds.MOST_SEGMENTS} names", place=self.at(line, "segment"), fix=fix)
        return self.names.setdefault(text, len(self.names))

    def _short(self, row: list[str], line: int, column: str) -> BadRecord:
        return BadRecord(f"only {len(row)} cells", place=self.at(line, column), fix=CUT)

    def at(self, line: int, column: str) -> str:
        """Name a cell in messages."""
        return f"{self.name}, line {line}, column {column}"


def read_csv(content: bytes, path: Path, pulse_rate_hz: float | None, column_map: ColumnMap) -> Record:
    """Read a record from the bytes of a table; `path` names it in messages, `column_map` is the parsed `--map`.

    The pulse rate is 40 Hz unless the file or the caller gives another. Raises BadRecord: with file, line, column
    and fix.
    """
    name = str(path)
    encoding, encoded = encoding_of(content, name)
    layout = find_layout(content, encoding, column_map, name)
    known = columns.columns(layout.header, column_map, layout.units, f"{name}, line {layout.line}")
    cells = _cells_of_parts(layout.header, known, f"{name}, line {layout.line}")
    table = Table(name, known, cells, commas=layout.separator != ",")
    table.fill(layout.rows)
    if not table.lines:
        place = f"{name}, line {layout.line + 1}"
        raise BadRecord("no row under the header", place=place, fix="Give a few seconds of data.")
    numbers = {column: np.array(values) for column, values in table.numbers.items()}
    if "segment" in known:
        numbers["segment"] = np.array(table.segment)
    file = FileContent(
        columns=numbers,
        names=list(table.names),
        name=name,
        cell=lambda row, column: f"line {table.lines[row]}, column {column}",
        source=file_source(content, path, known, encoded, _written(layout, table)),
        pulse_rate_hz=pulse_rate_hz or PULSE_RATE_HZ,
    )
    return join.read_joined(file, table.parts, pulse_rate_hz) if cells else record_of(file)


def _written(layout: Layout, table: Table) -> str:
    """Describe the assumptions on how the table is written."""
    written = []
    if layout.separator != ",":
        written.append(f"{SEPARATORS[layout.separator]} between cells")
    if table.decimal == ",":
        written.append("decimal commas")
    if layout.line != 1:
        written.append(f"header in line {layout.line}" if layout.line else "no header")
    return ", ".join(written)


def _cells_of_parts(header: list[str], known: dict[str, Column], place: str) -> dict[str, int]:
    """Where a joined record describes its parts; `part` joins the known columns then."""
    header = [cell.strip() for cell in header]
    # One of them alone is a column of somebody else's.
    if not {"part", "pause_s", "segment"} <= set(header):
        return {}
    if twice := [column for column in ("part", *join.CELLS) if header.count(column) > 1]:
        raise BadRecord(f"column {twice[0]} is there twice", place=place, fix="Keep one of them.")
    known["part"] = Column(header.index("part"))
    return {column: header.index(column) for column in join.CELLS if column in header}

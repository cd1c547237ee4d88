"""A table of text, as the rig or another tool wrote it (docs/recording.md).

Numbers are read by `numpy.loadtxt`, line by line, so that memory follows the numbers and not what else is in the file;
the layout is found, and each cell that cannot be taken is named, here."""

from __future__ import annotations

import codecs
import csv
import io
import re
from array import array
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import chain, islice
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds, columns, join
from stimrig.identify.records.cells import as_written, is_number
from stimrig.identify.records.columns import Column, ColumnMap
from stimrig.identify.records.table import Table

LONGEST_LINE = 10_000
"""Characters; no row of numbers has as many."""
MOST_BEFORE = 100
"""Lines before the header at most."""
BLANKS = " "
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", BLANKS: "blanks"}
COMMENTS = ("#", "%", "//")
PLAIN = "0123456789+-."
"""With what a row of numbers begins."""
PACKED = {
    b"\x1f\x8b": ("packed with gzip", "Unpack it with gunzip first."),
    b"PK\x03\x04": ("an Excel workbook or a ZIP archive", "Save the sheet as CSV text, or unpack the archive."),
    b"\xd0\xcf\x11\xe0": ("an old Excel workbook", "Save the sheet as CSV text."),
}
"""First bytes of tables that are not text, with the kind of file and the fix."""
MISSING = {"", "nan", "na", "n/a", "n.a.", "#n/a", "#nv", "null", "none", "-", "--"}
"""Texts that tools write where they have no number."""
CLOCK = re.compile(r"\d+[-/.:]\d+[-/.:]\d+")
CUT = "Every row needs every column; was the file cut off?"


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
    try:
        for _ in codecs.iterdecode(iter(partial(io.BytesIO(content).read, bounds.PIECE_BYTES), b""), "utf-8"):
            pass
    except UnicodeDecodeError:
        return "cp1252", "not UTF-8: read as Windows-1252 (Latin-1) text"
    return "utf-8-sig", ""


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


class _Text:
    """A table of text. Making it finds encoding, separator, header and row of units; then its rows are read.

    Raises BadRecord: no text, or no line among the first names the columns that a record needs.
    """

    def __init__(self, content: bytes, name: str, column_map: ColumnMap) -> None:
        self.content, self.name = content, name
        self.encoding, self.encoded = encoding_of(content, name)
        self.lines = array("L")
        """The line of each row, once it is read."""
        self.segment_names: list[str] = []
        self.segment_codes: dict[str, int] = {}
        """The code of each segment's name, by the cells that hold it."""
        self.decimal = ""
        """The decimal sign, once one was met in a number that is not written plainly."""
        self.separator, self.header, self.line, self.skipped = self._find_header(column_map)
        self.units: list[str] = []
        first = _cells(next(self.rows(), ""), self.separator)
        known = {unit for units in columns.UNITS.values() for unit in units}
        if any(columns.plain_unit(cell) in known for cell in first) and not any(map(is_number, first)):
            self.units, self.skipped = first, self.lines[0]

    def _find_header(self, column_map: ColumnMap) -> tuple[str, list[str], int, int]:
        """Separator, names, their line (0 where columns are chosen by number), and the lines before the rows."""
        before: list[str] = []
        best: tuple[float, int, list[str]] = (0.0, 1, [])
        by_number = all(column_map.get(target, "").startswith("#") for target in columns.NEEDED)
        for number, line in islice(self._numbered_lines(), MOST_BEFORE):
            before.append(line)
            names = line.strip().lstrip("#%").strip() if line.lstrip()[:1] in ("#", "%") else line
            for separator in SEPARATORS:
                cells = _cells(names, separator) if separator in names else []
                indices_of = columns.places(cells, column_map)
                if len(cells) >= len(columns.NEEDED) and indices_of.keys() >= set(columns.NEEDED):
                    if not by_number:
                        return separator, cells, number, number
                    if all(_looks_like_number(cells[indices_of[target][0]]) for target in columns.NEEDED):
                        return separator, cells, 0, number - 1
                words = sum(bool(cell) and not _looks_like_number(cell) for cell in cells)
                if (score := len(indices_of) + 0.5 * (words >= 3)) > best[0]:
                    best = score, number, cells
        _, number, cells = best
        if cells:
            columns.columns(cells, column_map, [], f"{self.name}, line {number}")  # says which column is missing
            fix = "Put one line with the columns' names before the numbers, or name each column with --map."
            raise self.bad("no numbers follow the header", fix, number)
        fix = "The first line must be time_s,pulse_width_us,torque_nm,segment, or name your columns with --map."
        is_filled = any(line.strip("\ufeff \t\r\n") for line in before)
        if is_filled and is_number(re.split(r"[,;|\s]+", before[0].strip())[0]):
            fix = "Say which column is which: --map time_s=#1:s --map pulse_width_us=#2:µs --map torque_nm=#3:Nm."
        raise self.bad("no header" if is_filled else "empty", fix, 1)

    def _numbered_lines(self) -> Iterator[tuple[int, str]]:
        return enumerate(text_lines(self.content, self.encoding, self.name), start=1)

    def bad(self, message: str, fix: str, line: int = 0, column: str = "") -> BadRecord:
        """The error at a line; without one at the row that was read last."""
        place = f"{self.name}, line {line or self.lines[-1]}" + (f", column {column}" if column else "")
        return BadRecord(message, place=place, fix=fix)

    def rows(self) -> Iterator[str]:
        """Rows with numbers, and their lines into `lines`; comments and empty rows are passed over.

        Raises BadRecord: a row has more cells than the header has names, so it is not known which cell is which.
        """
        self.lines = array("L")
        source, nothing, width = self._numbered_lines(), f"{self.separator} \t\r\n", len(self.header)
        for number, row in islice(source, self.skipped, None):
            if row[0] not in PLAIN or '"' in row or row.count(self.separator) >= width:
                if not row.strip(nothing) or row.lstrip().startswith(COMMENTS):
                    continue
                if '"' in row and self.separator != BLANKS:  # a cell may have several lines
                    taken: list[str] = []
                    lines = (taken.append(line) or line for line in chain([row], (more for _, more in source)))
                    try:
                        next(csv.reader(lines, delimiter=self.separator), [])
                    except csv.Error as error:
                        raise self.bad(f"not CSV ({error})", "Is a quote not closed?", number) from error
                    row = "".join(taken)
                self._check_width(row, number, least=1)
            self.lines.append(number)
            yield row

    def _check_width(self, row: str, number: int, least: int) -> None:
        cells = enumerate(_cells(row, self.separator), start=1)
        used = max((index for index, cell in cells if cell.strip()), default=0)
        width = len(self.header)
        if least <= used <= width:
            return
        fix = "Name every column."
        if used < width:
            fix = f"The header is separated by {SEPARATORS[self.separator]}: separate the rows alike."
        elif self.separator == ",":
            fix = "Name every column; with decimal commas, separate the cells with semicolons."
        raise self.bad(f"{used} {'cell' if used == 1 else 'cells'} under a header of {width}", fix, number)

    def numbers(self, known: Mapping[str, Column]) -> dict[str, np.ndarray]:
        """The known columns, each in its own unit, NaN where there is no number; the code of each row's segment.

        Numbers are read as they are. Only where that fails they are read cell by cell: decimal commas, signs for no
        number, and the cell that is neither. Raises BadRecord: with line and column.
        """
        first = next(self.rows(), None)
        if first is None:
            raise self.bad("no row under the header", "Give a few seconds of data.", self.skipped + 1)
        self._check_width(first, self.lines[0], least=len(self.header) if self.separator == BLANKS else 2)
        failure = None
        for by_cell in (("segment", "pulse_rate_hz"), tuple(known)):
            self.segment_names, self.segment_codes = [], {}
            converters: dict[int | str, Callable[[str], float]] = {
                known[target].index: self._code if target == "segment" else partial(self._number, target)
                for target in by_cell
                if target in known
            }
            try:
                values = np.loadtxt(
                    self.rows(),
                    delimiter=None if self.separator == BLANKS else self.separator,
                    comments=None,
                    quotechar='"',
                    usecols=[column.index for column in known.values()],
                    converters=converters,
                    ndmin=2,
                )
                return dict(zip(known, values.T.copy(), strict=True))
            except ValueError as error:
                failure = error
        if failure is not None and isinstance(failure.__cause__, BadRecord):
            raise failure.__cause__
        last = next(row for number, row in self._numbered_lines() if number == self.lines[-1])
        width = len(_cells(last, self.separator))
        short = next((target for target, column in known.items() if column.index >= width), "")
        raise self.bad(f"only {width} cells", CUT, column=short) from failure

    def _code(self, cell: str) -> int:
        code = self.segment_codes.get(cell)
        if code is None:
            name = as_written(cell.strip())
            if name not in self.segment_names:
                self.segment_names.append(name)
                bounds.check_names(self.segment_names, f"{self.name}, line {self.lines[-1]}, column segment")
            code = self.segment_codes[cell] = self.segment_names.index(name)
        return code

    def _number(self, column: str, cell: str) -> float:
        text = cell.strip()
        if text.lower() in MISSING:
            return np.nan
        fix = "Write all numbers with a decimal point, without signs between thousands."
        for sign in (sign for sign in ",." if sign in text):
            if sign == self.separator or self.decimal not in ("", sign):
                after = f"after numbers with a decimal {'comma' if sign == '.' else 'point'}"
                message = f"{columns.short(text)!r} {after if self.decimal else 'between separating commas'}"
                raise self.bad(message, fix, column=column)
            self.decimal = sign
        if is_number(text := text.replace(",", ".")):
            return float(text)
        if CLOCK.search(text):
            fix = "Times of a calendar or of a clock are not read: give seconds in a column."
        raise self.bad(f"{columns.short(cell.strip())!r} is no number", fix, column=column)

    def part_cells(self, part: np.ndarray) -> dict[int, dict[str, str]]:
        """Of a joined record: the cells that describe each part, by the row that it begins with."""
        firsts = np.flatnonzero(np.diff(part, prepend=np.nan))
        if firsts.size > bounds.MOST_PARTS:
            raise self.bad("too many parts", f"At most {bounds.MOST_PARTS} in one record.", self.lines[firsts[-1]])
        row_of = {self.lines[row]: row for row in firsts.tolist()}
        lines = ((row_of[number], line) for number, line in self._numbered_lines() if number in row_of)
        cells = ((row, map(as_written, _cells(line, self.separator))) for row, line in lines)
        return {row: dict(zip(self.header, texts, strict=False)) for row, texts in cells}


def _cells(row: str, separator: str) -> list[str]:
    """The cells of a row; a unit in brackets behind a blank is of the cell before."""
    if separator == BLANKS:
        return re.sub(r"[ \t]+([\[(][^\[\]()]{0,40}[\])])", r"\1", row).split()
    try:
        return [cell.strip() for cell in next(csv.reader([row.strip("\r\n")], delimiter=separator), [])]
    except csv.Error:
        return []


def _looks_like_number(cell: str) -> bool:
    return is_number(cell.replace(",", "."))


def read_csv(content: bytes, path: Path, column_map: ColumnMap) -> Table:
    """Read a table of text from its bytes; `path` names it in messages, `column_map` is the parsed `--map`.

    Raises BadRecord: with file, line, column and fix.
    """
    text = _Text(content, str(path), column_map)
    known = columns.columns(text.header, column_map, text.units, f"{path}, line {text.line}")
    is_joined = {"part", "segment", *join.CELLS} <= set(text.header)
    if is_joined:
        known["part"] = Column(text.header.index("part"))
    numbers = text.numbers(known)
    written = [f"{SEPARATORS[text.separator]} between cells"] if text.separator != "," else []
    written += ["decimal commas"] if text.decimal == "," else []
    if text.line != 1:
        written.append(f"header in line {text.line}" if text.line else "no header")
    return Table.of(
        content,
        path,
        known,
        numbers,
        segment_names=text.segment_names,
        cell=lambda row, column: f"line {text.lines[row]}, column {column}",
        notes=(text.encoded, ", ".join(written)),
        part_cells=text.part_cells(numbers["part"]) if is_joined else {},
    )

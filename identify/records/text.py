"""Bytes of a table as lines of text and rows of cells: encoding, separator, what stands before the header."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds, columns, units
from stimrig.identify.records.columns import Given

LONGEST_LINE = 10_000
"""Characters; no row of numbers has as many."""
MOST_BEFORE = 100
"""Lines before the header at most."""
BLANKS = " "
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", BLANKS: "blanks"}
COMMENTS = ("#", "%", "//")
PIECE_BYTES = 2**20
Row = tuple[int, list[str]]


def encoding_of(content: bytes, name: str) -> tuple[str, str]:
    """The codec of a text, and what of it was assumed (empty where the text says it itself).

    Raises
    ------
    BadRecord
        No text.
    """
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
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        for start in range(0, len(content), PIECE_BYTES):
            decoder.decode(content[start : start + PIECE_BYTES])
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return False
    return True


def lines(content: bytes, encoding: str, name: str) -> Iterator[str]:
    """The file's lines, none too long and not too many.

    Raises
    ------
    BadRecord
        Too long, too many, or bytes that are no text.
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
    """How a table is laid out, and its rows from the first one with numbers on."""

    separator: str
    header: list[str]
    line: int
    rows: Iterator[Row]
    units: list[str] = field(default_factory=list)


def layout(content: bytes, encoding: str, given: Given, name: str) -> Layout:
    """Find header and separator among the first lines.

    Raises
    ------
    BadRecord
        No line names the columns that a record needs, or the rows do not stand under it.
    """
    source = lines(content, encoding, name)
    before: list[str] = []
    for number, line in enumerate(source, start=1):
        before.append(line)
        if number > MOST_BEFORE:
            break
        for separator in SEPARATORS:
            cells = _cells(line, separator)
            if len(cells) < len(columns.NEEDED) or not columns.complete(columns.places(cells, given)):
                continue
            if not _numbered(given):
                return _below(
                    Layout(separator, cells, number, _rows(source, separator, number + 1, name)), content, name
                )
            if _is_numbers(cells, given):
                return Layout(separator, cells, 0, _rows(chain([line], source), separator, number, name))
    raise _no_header(before, given, name)


def _numbered(given: Given) -> bool:
    """Whether columns are asked for by number, so that a header need not be."""
    return all(target in given and given[target].name.startswith("#") for target in columns.NEEDED)


def _is_numbers(cells: list[str], given: Given) -> bool:
    at = [columns.places(cells, given)[target][0] for target in columns.NEEDED]
    return all(is_number(cells[index].replace(",", ".")) for index in at)


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


def _below(found: Layout, content: bytes, name: str) -> Layout:
    """With the row of units below the header, if there is one, taken off the rows, and comments left out."""
    double = 2 * found.separator
    if any(f"\n{sign}".encode() in content for sign in (*COMMENTS, double)) or b"\0" in content:
        found.rows = ((line, row) for line, row in found.rows if not _is_aside(row))
    found.rows = _no_wider(found, found.rows, name)
    first = next(found.rows, None)
    if first is None:
        return found
    line, row = first
    filled = [cell.strip() for cell in row if cell.strip()]
    known = {unit for target in units.UNITS for unit in units.UNITS[target]}
    if any(units.plain(cell) in known for cell in filled) and not any(is_number(cell) for cell in filled):
        found.units = row
        return found
    _check_width(found, line, row, name)
    found.rows = chain([first], found.rows)
    return found


def _is_aside(row: list[str]) -> bool:
    """Whether a row is a comment, or holds nothing."""
    return row[0].lstrip().startswith(COMMENTS) or not any(cell.strip() for cell in row)


def _no_wider(found: Layout, rows: Iterator[Row], name: str) -> Iterator[Row]:
    """The rows; one further down with more cells than the header is refused as the first one is."""
    width = len(found.header)
    for line, row in rows:
        if len(row) > width and any(cell.strip() for cell in row[width:]):
            _check_width(found, line, row, name)
        yield line, row


def _check_width(found: Layout, line: int, row: list[str], name: str) -> None:
    """Refuse rows that have more cells than the header has names: it is not known which cell is which."""
    used = max((index for index, cell in enumerate(row, start=1) if cell.strip()), default=0)
    if used == len(found.header) or (used < len(found.header) and used > 1 and found.separator != BLANKS):
        return
    fix = "Name every column."
    if used < len(found.header):
        fix = f"The header is separated by {SEPARATORS[found.separator]}: separate the rows alike."
    elif found.separator == ",":
        fix = "Name every column; with decimal commas, separate the cells with semicolons."
    message = f"{used} {'cell' if used == 1 else 'cells'} under a header of {len(found.header)}"
    raise BadRecord(message, place=f"{name}, line {line}", fix=fix)


def _no_header(before: list[str], given: Given, name: str) -> BadRecord:
    """What is missing in the line that comes closest to a header."""
    best: tuple[float, int, list[str]] = (0.0, 1, [])
    for number, line in enumerate(before, start=1):
        for separator in SEPARATORS:
            cells = _cells(line, separator)
            score = len(columns.places(cells, given)) + (0.5 if sum(map(_is_word, cells)) >= 3 else 0)
            if score > best[0]:
                best = (score, number, cells)
    _, number, cells = best
    fix = "The first line must be time_s,pulse_width_us,torque_nm,segment, or name your columns with --map."
    if not cells:
        filled = any(line.strip("\ufeff \t\r\n") for line in before)
        if filled and any(is_number(cell) for cell in re.split(r"[,;|\s]+", before[0].strip())[:1]):
            fix = "Say which column is which: --map time_s=#1:s --map pulse_width_us=#2:µs --map torque_nm=#3:Nm."
        return BadRecord("no header" if filled else "empty", place=f"{name}, line 1", fix=fix)
    try:
        columns.columns(cells, given, [], f"{name}, line {number}")
    except BadRecord as error:
        return error
    fix = "Put one line with the columns' names before the numbers, or name each column with --map."
    return BadRecord("no numbers follow the header", place=f"{name}, line {number}", fix=fix)


def _is_word(cell: str) -> bool:
    return bool(cell) and not is_number(cell.replace(",", "."))


def is_number(cell: str) -> bool:
    """Whether a cell is a number as a measuring tool writes it: no digits of other scripts, no underscores."""
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell

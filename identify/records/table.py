"""The rows of a table as arrays of numbers: fast where they are sound, exact about line and column where not."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping
from itertools import islice

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.cells import as_written
from stimrig.identify.records.columns import MAY_LACK, Column
from stimrig.identify.records.text import Row, is_number

BLOCK = 4096
CUT = "Every row needs every column; was the file cut off?"
MISSING = {"", "nan", "na", "n/a", "n.a.", "#n/a", "#nv", "null", "none", "-", "--"}
"""What tools write where they have no number."""


class Table:
    """What the rows hold: numbers by column, segments by name, and the line each row stands in.

    Parameters
    ----------
    name : str
        How messages call the file.
    columns : mapping of str to Column
        Where each column stands, and its factor; a `segment` may be missing.
    cells : mapping of str to int
        Where the cells stand that describe a part; empty where the file has none.
    commas : bool
        Whether numbers may have decimal commas: not where commas separate the cells.
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
        """Take all rows in.

        Raises
        ------
        BadRecord
            With file, line and column.
        """
        source = iter(rows)
        while block := list(islice(source, BLOCK)):
            self._take([row for _, row in block], [line for line, _ in block])

    def _take(self, rows: list[list[str]], lines: list[int]) -> None:
        for column, values in self.numbers.items():
            values.extend(self._column(rows, column, lines))
        if self.cells:
            self._take_parts(rows, lines)
        if "segment" in self.columns:
            self._take_segments(rows, lines)
        self.lines.extend(lines)

    def _take_segments(self, rows: list[list[str]], lines: list[int]) -> None:
        at = self.columns["segment"].index
        for row, line in zip(rows, lines, strict=True):
            if len(row) <= at:
                raise self._short(row, line, "segment")
            text = as_written(row[at].strip())
            code = self.names.get(text)
            self.segment.append(self._new_name(text, line) if code is None else code)

    def _take_parts(self, rows: list[list[str]], lines: list[int]) -> None:
        """Keep the cells of each row with which a part begins."""
        before = len(self.lines)
        number = np.array(self.numbers["part"][max(before - 1, 0) :])
        firsts = np.flatnonzero(np.diff(number)) + (0 if before else 1)
        for index in firsts.tolist() if before else [0, *firsts.tolist()]:
            row = rows[index]
            if len(row) <= max(self.cells.values()):
                raise self._short(row, lines[index], "pause_s")
            self.parts[before + index] = {column: as_written(row[at].strip()) for column, at in self.cells.items()}
            if len(self.parts) > bounds.MOST_PARTS:
                fix = f"At most {bounds.MOST_PARTS} in one record."
                raise BadRecord("too many parts", place=self.at(lines[index], "part"), fix=fix)

    def _column(self, rows: list[list[str]], column: str, lines: list[int]) -> np.ndarray:
        """The numbers of a column in its own unit; NaN where the file has none."""
        found = self.columns[column]
        try:
            cells = [row[found.index] for row in rows]
        except IndexError:
            row, line = next(pair for pair in zip(rows, lines, strict=True) if len(pair[0]) <= found.index)
            raise self._short(row, line, column) from None
        text = "".join(cells)
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
        if found.factor != 1.0:
            values *= found.factor
        missing = np.isnan(values) if column in MAY_LACK else False
        bad = np.flatnonzero(~(np.abs(values) <= bounds.largest(column)) & ~np.asarray(missing))
        if bad.size:
            shown = _shown(cells[bad[0]].strip())
            fix = "Remove the row's cause, or cut the record before it; values must be finite."
            fix = bounds.fix_of(column, values[bad], fix)
            raise BadRecord(
                f"{shown} is no measurement" if shown else "empty", place=self.at(lines[bad[0]], column), fix=fix
            )
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
            message = f"{_shown(cell)!r} {other if self.decimal else 'between separating commas'}"
            fix = "Write all numbers with a decimal point, without signs between thousands."
            raise BadRecord(message, place=self.at(line, column), fix=fix)

    def _number(self, cell: str, column: str, line: int) -> float:
        """One number; NaN where the tool says that it has none."""
        if cell.strip().lower() in MISSING:
            return np.nan
        if is_number(cell):
            return float(cell)
        message, fix = f"{_shown(cell)!r} is no number", "Give a number with a decimal point."
        raise BadRecord(message, place=self.at(line, column), fix=fix)

    def _new_name(self, text: str, line: int) -> int:
        bounds.check_name(text, self.at(line, "segment"))
        if len(self.names) == bounds.MOST_SEGMENTS:
            fix = "Name segments by what they are (rest, prbs…), not each row."
            raise BadRecord(f"more than {bounds.MOST_SEGMENTS} names", place=self.at(line, "segment"), fix=fix)
        return self.names.setdefault(text, len(self.names))

    def _short(self, row: list[str], line: int, column: str) -> BadRecord:
        return BadRecord(f"only {len(row)} cells", place=self.at(line, column), fix=CUT)

    def at(self, line: int, column: str) -> str:
        """How messages call a cell."""
        return f"{self.name}, line {line}, column {column}"


def _shown(cell: str) -> str:
    return cell if len(cell) <= 40 else f"{cell[:40]}…"

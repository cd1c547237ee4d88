"""Cells of tables: what is a number, and what a spreadsheet must not compute: a segment's, file's or person's name.

A text that begins like a formula gets an apostrophe, by which a spreadsheet takes it for text (OWASP, CSV injection).
So does one behind a comma or semicolon, where a spreadsheet of another language separates. Our readers take it off.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator

SIGNS = r"=+\-@\t\r\n\uff1d\uff0b\uff0d\uff20"
"""With what a formula begins; the last four are the wide ones of Asian keyboards."""
FORMULA = re.compile(rf"(^ *|[;,] *)('*[{SIGNS}])")
QUOTED_SIGN = re.compile(rf"(^ *|[;,] *)'('*[{SIGNS}])")


def cell_text(text: str) -> str:
    """A text as it stands in a cell."""
    return FORMULA.sub(r"\1'\2", text)


def as_written(cell: str) -> str:
    """The text that `cell_text` made this cell of."""
    return QUOTED_SIGN.sub(r"\1\2", cell) if "'" in cell else cell


def cell(value: str | float | None) -> str:
    """A value as it stands in a cell: a number stays one, also a negative one."""
    if value is None:
        return ""
    if isinstance(value, str):
        return cell_text(value)
    return f"{value:.8g}" if isinstance(value, float) else str(value)


def is_number(cell: str) -> bool:
    """Return true for a number as a measuring tool writes it: no digits of other scripts, no underscores."""
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell


def lines(rows: Iterable[Iterable[str | float | None]], end: str = "\n") -> Iterator[str]:
    """Rows as the lines of a CSV file."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator=end)
    for row in rows:
        writer.writerow(map(cell, row))
        yield text.getvalue()
        text.seek(0)
        text.truncate()


def quoted(text: str) -> str:
    """A text as it stands between two commas of a CSV line."""
    return next(lines([[text, ""]], end=""))[:-1]

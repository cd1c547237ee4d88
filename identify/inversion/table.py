"""A reference torque as a table of text: `time_s,torque_nm`, or `torque_nm` alone with one row for each pulse."""

from __future__ import annotations

import numpy as np

from identify.errors import BadRecord
from identify.inversion.reference import MOST_SAMPLES, Reference
from identify.records import text

FIX = "Give a header time_s,torque_nm (or torque_nm alone) and one row of numbers a line."
NAMES = {"time_s": "time_s", "torque_nm": "torque_nm", "reference_torque_nm": "torque_nm"}


def read_reference(content: bytes, name: str, pulse_rate_hz: float = 40.0) -> Reference:
    """The reference in a CSV file; semicolons or tabs between cells and decimal commas are read, too.

    Parameters
    ----------
    content : bytes
        The file.
    name : str
        How messages call it.
    pulse_rate_hz : float
        Pulses per second.

    Raises
    ------
    BadRecord
        It is no such table: with line and column.
    BadRequest
        As `Reference.of`.
    """
    encoding, _ = text.encoding_of(content, name)
    lines = (line.strip() for line in text.lines(content, encoding, name))
    rows = [(number, line) for number, line in enumerate(lines, 1) if line and not line.startswith(text.COMMENTS)]
    if not rows:
        raise BadRecord("empty", place=name, fix=FIX)
    number, head = rows[0]
    separator = next((sign for sign in ";\t," if sign in head), ",")
    header = [cell.strip().strip('"').lower() for cell in head.split(separator)]
    known = [NAMES[cell] for cell in header if cell in NAMES]
    if sorted(known) not in (["time_s", "torque_nm"], ["torque_nm"]):
        raise BadRecord("no header with torque_nm", place=f"{name}, line {number}", fix=FIX)
    if len(rows) - 1 > MOST_SAMPLES:
        raise BadRecord(f"{len(rows) - 1} rows", place=name, fix=f"Give at most {MOST_SAMPLES}.")
    columns: dict[str, list[float]] = {column: [] for column in known}
    for number, line in rows[1:]:
        cells = line.split(separator)
        for at, cell in enumerate(header):
            if cell in NAMES:
                place = f"{name}, line {number}, column {cell}"
                columns[NAMES[cell]].append(_number(cells[at] if at < len(cells) else "", separator, place))
    return Reference.of(
        np.array(columns["torque_nm"]), columns.get("time_s"), pulse_rate_hz=pulse_rate_hz, name=f"{name}, torque_nm"
    )


def _number(cell: str, separator: str, place: str) -> float:
    written = cell.strip().strip('"')
    if separator != ",":
        written = written.replace(",", ".")
    try:
        value = float(written) if written.isascii() and "_" not in written else np.nan
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise BadRecord(f"{written[:20]!r} is not a finite number", place=place, fix=FIX)
    return value

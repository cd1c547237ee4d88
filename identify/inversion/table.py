"""A reference torque as a table of text: `time_s,torque_nm`, or `torque_nm` alone with one row for each pulse.

Of a joint that moves `angle_rad` beside it.
"""

from __future__ import annotations

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.inversion.reference import MOST_SAMPLES, Reference
from stimrig.identify.records.csv import COMMENTS, encoding_of, text_lines

FIX = "Give a header time_s,torque_nm (or torque_nm alone) and one row of numbers a line."
NAMES = {
    "time_s": "time_s",
    "torque_nm": "torque_nm",
    "reference_torque_nm": "torque_nm",
    "angle_rad": "angle_rad",
}


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
    encoding, _ = encoding_of(content, name)
    lines = ((number, line.strip("\r\n ")) for number, line in enumerate(text_lines(content, encoding, name), 1))
    rows = ((number, line) for number, line in lines if line.strip() and not line.startswith(COMMENTS))
    number, head = next(rows, (0, ""))
    if not head:
        raise BadRecord("empty", place=name, fix=FIX)
    separator = next((sign for sign in ";\t," if sign in head), ",")
    header = [cell.strip().strip('"').lower() for cell in head.split(separator)]
    known = [NAMES[cell] for cell in header if cell in NAMES]
    if sorted(set(known) - {"time_s", "angle_rad"}) != ["torque_nm"] or len(set(known)) != len(known):
        raise BadRecord("no header with torque_nm", place=f"{name}, line {number}", fix=FIX)
    columns: dict[str, list[float]] = {column: [] for column in known}
    for count, (number, line) in enumerate(rows, 1):
        if count > MOST_SAMPLES:
            fix = f"Give at most {MOST_SAMPLES}: one for each pulse is enough."
            raise BadRecord(f"more than {MOST_SAMPLES} rows", place=f"{name}, line {number}", fix=fix)
        cells = line.split(separator)
        _refuse_wider(cells, len(header), separator, f"{name}, line {number}")
        for at, cell in enumerate(header):
            if cell in NAMES:
                place = f"{name}, line {number}, column {cell}"
                columns[NAMES[cell]].append(_number(cells[at] if at < len(cells) else "", separator, place))
    return Reference.of(
        np.array(columns["torque_nm"]),
        columns.get("time_s"),
        angle_rad=columns.get("angle_rad"),
        pulse_rate_hz=pulse_rate_hz,
        name=f"{name}, torque_nm",
    )


def _refuse_wider(cells: list[str], width: int, separator: str, place: str) -> None:
    """Refuse a row with more cells than the header: the comma of a decimal makes two cells of one number."""
    if any(cell.strip() for cell in cells[width:]):
        fix = "Name every column."
        if separator == ",":
            fix = "Name every column; with decimal commas, separate the cells with semicolons, or write decimal points."
        raise BadRecord(f"{len(cells)} cells under a header of {width}", place=place, fix=fix)


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

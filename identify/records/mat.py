"""A record from a MAT file: variables, or the fields of one struct, named as the columns of a table."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds, columns
from stimrig.identify.records.assemble import PULSE_RATE_HZ, Found, record_of
from stimrig.identify.records.columns import Column, Given
from stimrig.identify.records.mat_file import CELL, CHAR, FIX, BadMat, Variable, variables
from stimrig.identify.records.record import Record, Source

RATE = "pulse_rate_hz"
"""A variable of one number that says the pulse rate."""
MOST_TOLD = 12


def read_mat(content: bytes, path: Path, pulse_rate_hz: float | None = None, given: Given | None = None) -> Record:
    """A record of a MAT file from its bytes; `path` is how it is called, `given` what `--map` says.

    Raises
    ------
    BadRecord
        With the file and the variable, and what to do.
    """
    name = str(path)
    scope, known, given = _scope(variables(content, name), given or {}, name)
    header = list(known)
    found = columns.columns(header, given, [], f"{name}, {scope}" if scope else name)
    of = {
        target: f"{scope}.{header[column.index]}" if scope else header[column.index] for target, column in found.items()
    }

    def cell(row: int, column: str) -> str:
        return f"{of[column]}({row + 1})"

    numbers = {
        target: _numbers(known[header[column.index]], column, f"{name}, {of[target]}")
        for target, column in found.items()
        if target != "segment"
    }
    _check_lengths(numbers, of, name)
    segment, names = None, []
    if "segment" in found:
        variable = known[header[found["segment"].index]]
        segment, names = _segments(variable, numbers["time_s"].size, f"{name}, {of['segment']}")
    if pulse_rate_hz is None and RATE in known:
        pulse_rate_hz = float(_numbers(known[RATE], Column(0), f"{name}, {RATE}")[:1].sum())
        bounds.check_rate(pulse_rate_hz, f"{name}, {RATE}")
    notes = "; ".join(column.note for column in found.values() if column.note)
    source = Source(path.name, sha256=hashlib.sha256(content).hexdigest(), notes=(notes,) if notes else ())
    return record_of(Found(numbers, segment, names, name, cell, source, pulse_rate_hz or PULSE_RATE_HZ))


def _scope(top: Mapping[str, Variable], given: Given, name: str) -> tuple[str, Mapping[str, Variable], Given]:
    """Where the columns are: among the variables themselves ("") or in one struct; and `--map` as it reads there."""
    if columns.complete(columns.places(list(top), given)):
        return "", top, given
    scopes = []
    for title, variable in top.items():
        try:
            fields = variable.fields()
        except BadMat as error:
            raise BadRecord(str(error), place=f"{name}, {title}", fix=FIX) from error
        inside = {target: replace(asked, text=asked.text.removeprefix(f"{title}.")) for target, asked in given.items()}
        if fields and columns.complete(columns.places(list(fields), inside)):
            scopes.append((title, fields, inside))
        if len(scopes) > 1:  # at once: each struct that is opened holds its unpacked bytes
            both = " and ".join(title for title, *_ in scopes)
            raise BadRecord(f"records in {both}", place=name, fix="Save each in a file of its own.")
    if not scopes:
        raise _nothing(top, given, name)
    return scopes[0]


def _nothing(top: Mapping[str, Variable], given: Given, name: str) -> BadRecord:
    if not top:
        return BadRecord("no variable", place=name, fix=FIX)
    try:
        columns.columns(list(top), given, [], name)
    except BadRecord as error:
        return error
    raise AssertionError("columns that could not be found can be read")


def _numbers(variable: Variable, column: Column, place: str) -> np.ndarray:
    try:
        return variable.numbers() * column.factor
    except BadMat as error:
        raise BadRecord(str(error).rstrip("."), place=place) from error


def _check_lengths(numbers: Mapping[str, np.ndarray], of: Mapping[str, str], name: str) -> None:
    size = numbers["time_s"].size
    for target, column in numbers.items():
        if column.size != size:
            message = f"{column.size} numbers, and {of['time_s']} has {size}"
            raise BadRecord(message, place=f"{name}, {of[target]}", fix="Give one for each sample.")
    if not size:
        raise BadRecord("no number", place=f"{name}, {of['time_s']}", fix="Give a few seconds of data.")


def _segments(variable: Variable, size: int, place: str) -> tuple[np.ndarray, list[str]]:
    """A number for each row's segment, and the names by number; one text stands for all rows."""
    try:
        texts = variable.texts() if variable.kind in (CHAR, CELL) else [f"{code:g}" for code in variable.numbers()]
    except BadMat as error:
        raise BadRecord(str(error).rstrip("."), place=place) from error
    if len(texts) == 1:
        texts = texts * size
    if len(texts) != size:
        raise BadRecord(f"{len(texts)} names for {size} samples", place=place, fix="Give one for each sample.")
    names: dict[str, int] = {}
    code = np.array([names.setdefault(text.strip(), len(names)) for text in texts])
    if len(names) > bounds.MOST_SEGMENTS:
        raise BadRecord(f"{len(names)} different names", place=place, fix="Name segments by what they are.")
    for text in names:
        bounds.check_name(text, place)
    return code, list(names)

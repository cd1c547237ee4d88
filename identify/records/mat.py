"""A record from a MAT file (versions 5 to 7): variables, or the fields of one struct, named as the columns of a table.

A MAT file may declare a terabyte in a few bytes, unpack to one, and hold objects and function handles. `scipy.io` takes
memory for what is declared before it looks whether it is there, and ends the process at some damaged files; here each
bound is checked first, and only variables that are asked for are unpacked."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds, columns
from stimrig.identify.records.assemble import record_of
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES, LARGEST_ROWS, LONGEST_TEXT
from stimrig.identify.records.columns import ColumnMap
from stimrig.identify.records.file_content import PULSE_RATE_HZ, FileContent, file_source
from stimrig.identify.records.record import Record

HEADER_BYTES = 128
HEAD_BYTES = 4096
"""More than the head of any variable."""
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
MATRIX, PACKED = 14, 15
CELL, STRUCT, CHAR = 1, 2, 4
NUMERIC = range(6, 16)
COMPLEX = 0x0800
KINDS = {3: "an object", 5: "a sparse matrix", 16: "a function handle", 17: "an object (table, string, datetime, …)"}
MOST_VARIABLES = 10_000
FIX = "Save plain columns of numbers from MATLAB: save('record.mat', 'time_s', 'pulse_width_us', 'torque_nm', '-v7')."
OBJECTS = "Turn it into plain numbers or texts first: seconds(t), cellstr(s), table2struct(T, 'ToScalar', true)."


class BadPiece(Exception):
    """A piece of a file that is not what it is declared to be."""


def inflated(data: memoryview, max_bytes: int, whole: bool = True) -> bytes:
    """Unpack zlib data of at most `max_bytes`. Raises BadPiece: no zlib, or with `whole` data left over."""
    packer = zlib.decompressobj()
    try:
        unpacked = packer.decompress(data, max_bytes)
    except zlib.error as error:
        raise BadPiece("packed data that do not unpack") from error
    if whole and not packer.eof:
        raise BadPiece("packed data that are damaged, or longer than any record")
    return unpacked


@dataclass(frozen=True)
class Variable:
    """A variable by its head; its data are not read yet."""

    kind: int  # MATLAB's class
    shape: tuple[int, ...]  # its dimensions, as declared
    flags: int  # whether it is complex
    body: memoryview  # what follows its name
    order: str  # "<" or ">"
    packed: bool = False  # whether `body` holds the whole element as it was packed, its head included

    @property
    def size(self) -> int:
        """Number of elements, as declared."""
        return math.prod(self.shape)

    def _opened(self, most_bytes: int = LARGEST_FILE_BYTES) -> Variable:
        if not self.packed:
            return self
        whole = memoryview(inflated(self.body, most_bytes))
        tag, inside, _ = _element(whole, 0, self.order)
        if tag != MATRIX:
            raise BadPiece("a packed variable that is none")
        return _matrix(inside, self.order)[1]

    def numbers(self) -> np.ndarray:
        """Its numbers, as float64 in one dimension.

        Raises BadPiece: not real numbers in a row or a column, or not all there.
        """
        if self.kind not in NUMERIC:
            raise BadPiece(f"{KINDS.get(self.kind, 'no numbers')}. {OBJECTS}")
        if self.flags & COMPLEX:
            raise BadPiece("complex numbers. Give real ones.")
        if max(self.shape, default=0) != self.size or self.size > LARGEST_ROWS:
            message = f"{'×'.join(map(str, self.shape))} numbers. Give one row or column of at most {LARGEST_ROWS}."
            raise BadPiece(message)
        here = self._opened(8 * self.size + HEAD_BYTES)
        tag, data, _ = _element(here.body, 0, here.order)
        if tag not in NUMBERS or len(data) != here.size * np.dtype(NUMBERS[tag]).itemsize:
            raise BadPiece("numbers that are declared and not there")
        return np.frombuffer(data, here.order + NUMBERS[tag]).astype(float)

    def texts(self) -> list[str]:
        """Its texts: of a cell array each element's, of a character array each row's.

        Raises BadPiece: no texts, or not all there.
        """
        if self.kind not in (CHAR, CELL):
            raise BadPiece(f"{KINDS.get(self.kind, 'no texts')}. {OBJECTS}")
        if self.size > LARGEST_ROWS:
            raise BadPiece(f"{self.size} texts. At most {LARGEST_ROWS} are read.")
        here = self._opened()
        if here.kind == CHAR:
            return _rows_of(here)
        texts = []
        for cell in _matrices(here, here.size):
            if cell.kind != CHAR:
                raise BadPiece(f"a cell array with {KINDS.get(cell.kind, 'something')} in it. Give texts only.")
            texts.append("".join(_rows_of(cell)[:1]))
        return texts

    def fields(self) -> dict[str, Variable]:
        """The fields of a struct of one element; nothing for anything else. Raises BadPiece: damaged."""
        if self.kind != STRUCT or self.size != 1:
            return {}
        here = self._opened()
        _, length, place = _element(here.body, 0, here.order)
        _, names, place = _element(here.body, place, here.order)
        each = int.from_bytes(length[:4], "little" if here.order == "<" else "big")
        if not 0 < each <= 64 or len(names) % each or len(names) > 64 * MOST_VARIABLES:
            raise BadPiece("names of fields that are none")
        raw = bytes(names)
        titles = [_name(raw[at : at + each]) for at in range(0, len(raw), each)]
        return dict(zip(titles, _matrices(replace(here, body=here.body[place:]), len(titles)), strict=True))


def variables(content: bytes, name: str) -> dict[str, Variable]:
    """The variables of a MAT file by name, none of them unpacked.

    Raises BadRecord: no MAT file of version 5 to 7, or damaged.
    """
    order = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}.get(content[124:HEADER_BYTES])
    if order is None:
        what = "a MAT file of version 7.3" if content.startswith(b"MATLAB 7.3") else "no MAT file of version 5 to 7"
        raise BadRecord(what, place=name, fix=FIX)
    view, place = memoryview(content), HEADER_BYTES
    by_name: dict[str, Variable] = {}
    elements = 0
    try:
        while place + 8 <= len(view):
            tag, body, place = _element(view, place, order)
            title, variable = _listed(tag, body, order)
            if title:
                by_name[title] = variable
            elements += 1  # those without a name, or with one that was there before, count too
            if elements > MOST_VARIABLES:
                raise BadPiece(f"more than {MOST_VARIABLES} variables")
    except BadPiece as error:
        raise BadRecord(f"a damaged MAT file ({error})", place=name, fix=FIX) from error
    return by_name


def is_mat(content: bytes) -> bool:
    """Return true for a MAT file of version 5 to 7.3, by its first bytes."""
    return content.startswith(b"MATLAB") and content[126:HEADER_BYTES] in (b"IM", b"MI")


def _listed(tag: int, body: memoryview, order: str) -> tuple[str, Variable]:
    """Name and head of a variable; of a packed one, no more is unpacked than that takes."""
    if tag == MATRIX:
        return _matrix(body, order)
    if tag == PACKED:
        head = memoryview(inflated(body, HEAD_BYTES, whole=False))
        inside, _, _ = struct.unpack_from(order + "IIQ", head.tobytes().ljust(16, b"\0"))
        if inside == MATRIX:
            title, variable = _matrix(head[8:], order)
            return title, replace(variable, body=body, packed=True)
    return "", Variable(0, (), 0, body, order)


def _element(view: memoryview, place: int, order: str) -> tuple[int, memoryview, int]:
    """Tag and data of an element, and where the next one begins."""
    if not 0 <= place <= len(view) - 8:
        raise BadPiece("it ends within a variable")
    tag, size = struct.unpack_from(order + "II", view, place)
    if tag >> 16:  # up to four bytes stand in the tag itself
        size, tag = tag >> 16, tag & 0xFFFF
        if size > 4:
            raise BadPiece("a short element that is long")
        return tag, view[place + 4 : place + 4 + size], place + 8
    begin, end = place + 8, place + 8 + size
    if end > len(view):
        raise BadPiece("it ends within a variable")
    return tag, view[begin:end], end if tag == PACKED else end + -size % 8


def _matrix(body: memoryview, order: str) -> tuple[str, Variable]:
    """Name and head of a matrix; what follows its name stays closed."""
    _, flags, place = _element(body, 0, order)
    _, dims, place = _element(body, place, order)
    _, title, place = _element(body, place, order)
    if len(flags) != 8 or len(dims) % 4 or not 8 <= len(dims) <= 32 or len(title) > 64:
        raise BadPiece("a variable without a head")
    (word,) = struct.unpack_from(order + "I", flags)
    shape = tuple(np.frombuffer(dims, order + "i4").tolist())
    if min(shape) < 0:
        raise BadPiece("a variable of less than nothing")
    return _name(bytes(title)), Variable(word & 0xFF, shape, word & 0xFF00, body[place:], order)


def _matrices(here: Variable, count: int) -> Iterator[Variable]:
    place = 0
    for _ in range(count):
        tag, body, place = _element(here.body, place, here.order)
        if tag != MATRIX:
            raise BadPiece("a cell or field that is no variable")
        yield _matrix(body, here.order)[1] if len(body) else Variable(6, (0, 0), 0, body, here.order)


def _rows_of(here: Variable) -> list[str]:
    """The rows of a character array, without blanks behind."""
    if here.size == 0:
        return []
    tag, data, _ = _element(here.body, 0, here.order)
    codec = TEXTS.get(tag)
    if codec is None or len(here.shape) != 2 or here.size > LARGEST_ROWS or here.shape[1] > LONGEST_TEXT:
        raise BadPiece("texts that are none")
    order = {"<": "-le", ">": "-be"}[here.order] if codec in ("utf-16", "utf-32") else ""
    text = bytes(data).decode(codec + order, "replace")
    rows, length = here.shape
    if len(text) < here.size:
        raise BadPiece("texts that are declared and not there")
    return [text[row : rows * length : rows].rstrip() for row in range(rows)]


def _name(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("ascii", "replace")


RATE = "pulse_rate_hz"
"""A variable of one number that says the pulse rate."""


def read_mat(content: bytes, path: Path, pulse_rate_hz: float | None, column_map: ColumnMap) -> Record:
    """Read a record from the bytes of a MAT file; `path` names it in messages, `column_map` is the parsed `--map`.

    Raises BadRecord: with the file and the variable, and what to do.
    """
    name = str(path)
    scope, known, column_map = _scope(variables(content, name), column_map, name)
    header = list(known)
    mapped = columns.columns(header, column_map, [], f"{name}, {scope}" if scope else name)
    before = f"{scope}." if scope else ""
    of = {target: before + header[column.index] for target, column in mapped.items()}
    numbers: dict[str, np.ndarray] = {}
    for target, column in mapped.items():
        with _naming_place(f"{name}, {of[target]}"):
            if target != "segment":
                numbers[target] = known[header[column.index]].numbers() * column.factor
    _check_lengths(numbers, of, name)
    names: list[str] = []
    if "segment" in mapped:
        variable = known[header[mapped["segment"].index]]
        numbers["segment"], names = _segments(variable, numbers["time_s"].size, f"{name}, {of['segment']}")
    if pulse_rate_hz is None and RATE in known:
        with _naming_place(f"{name}, {RATE}"):
            pulse_rate_hz = float(known[RATE].numbers()[:1].sum())
        bounds.check_rate(pulse_rate_hz, f"{name}, {RATE}")
    source, rate_hz = file_source(content, path, mapped), pulse_rate_hz or PULSE_RATE_HZ
    return record_of(FileContent(numbers, names, name, lambda row, column: f"{of[column]}({row + 1})", source, rate_hz))


def _scope(
    top: Mapping[str, Variable], column_map: ColumnMap, name: str
) -> tuple[str, Mapping[str, Variable], ColumnMap]:
    """Find the struct with the columns ("": the variables themselves); with its fields, and `--map` relative to it."""
    if columns.complete(columns.places(list(top), column_map)):
        return "", top, column_map
    scopes = []
    for title, variable in top.items():
        with _naming_place(f"{name}, {title}", FIX):
            fields = variable.fields()
        prefix = f"{title}."
        inside = {key: replace(choice, text=choice.text.removeprefix(prefix)) for key, choice in column_map.items()}
        if fields and columns.complete(columns.places(list(fields), inside)):
            scopes.append((title, fields, inside))
        if len(scopes) > 1:  # at once: each struct that is opened holds its unpacked bytes
            both = " and ".join(title for title, *_ in scopes)
            raise BadRecord(f"records in {both}", place=name, fix="Save each in a file of its own.")
    if not top:
        raise BadRecord("no variable", place=name, fix=FIX)
    return scopes[0] if scopes else ("", top, column_map)


@contextmanager
def _naming_place(place: str, fix: str = "") -> Iterator[None]:
    """Raise a BadPiece of the block as a BadRecord with the place."""
    try:
        yield
    except BadPiece as error:
        raise BadRecord(str(error).rstrip("."), place=place, fix=fix) from error


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
    with _naming_place(place):
        texts = variable.texts() if variable.kind in (CHAR, CELL) else [f"{code:g}" for code in variable.numbers()]
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

"""A table from a MAT file (versions 5 to 7): variables and fields of structs, named as the columns of a table.

A MAT file may declare a terabyte in a few bytes, unpack to one, and hold objects and function handles. `scipy.io` takes
memory for what is declared before it looks whether it is there, and ends the process at some damaged files; here each
bound is checked first, and only variables that are asked for are unpacked."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds, columns
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES, LARGEST_ROWS, LONGEST_TEXT
from stimrig.identify.records.columns import ColumnMap
from stimrig.identify.records.table import Table

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
MOST_VARIABLES, MOST_FIELDS, DEEPEST = 10_000, 1000, 8
FIX = "Save plain columns of numbers from MATLAB: save('record.mat', 'time_s', 'pulse_width_us', 'torque_nm', '-v7')."
OBJECTS = "Turn it into plain numbers or texts first: seconds(t), cellstr(s), table2struct(T, 'ToScalar', true)."


class BadPiece(Exception):
    """A piece of a file that is not what it is declared to be."""


def inflated(data: memoryview, max_bytes: int, whole: bool = True) -> memoryview:
    """Unpack zlib data of at most `max_bytes`. Raises BadPiece: no zlib, or with `whole` data left over."""
    packer = zlib.decompressobj()
    try:
        unpacked = packer.decompress(data, max_bytes)
    except zlib.error as error:
        raise BadPiece("packed data that do not unpack") from error
    if whole and not packer.eof:
        raise BadPiece("packed data that are damaged, or longer than any record")
    return memoryview(unpacked)


def _elements(view: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Tag and data of each element that stands in these bytes."""
    place = 0
    while place + 8 <= len(view):
        tag, size = struct.unpack_from(order + "II", view, place)
        short = tag >> 16  # up to four bytes stand in the tag itself
        begin, end = (place + 4, place + 4 + short) if short else (place + 8, place + 8 + size)
        after = place + 8 if short else end if tag == PACKED else end + -size % 8
        if end > (place + 8 if short else len(view)):
            raise BadPiece("it ends within a variable")
        yield tag & 0xFFFF if short else tag, view[begin:end]
        place = after


class Variable(NamedTuple):
    """A variable by its head; its data are not read yet."""

    kind: int  # MATLAB's class
    shape: tuple[int, ...]  # its dimensions, as declared
    is_complex: bool
    body: memoryview  # its elements, head included; packed: the whole variable as it is in the file
    order: str  # of its bytes, "<" or ">"
    packed: bool = False

    @property
    def size(self) -> int:
        """Number of elements, as declared."""
        return math.prod(self.shape)

    def unpacked(self, max_bytes: int = LARGEST_FILE_BYTES) -> Variable:
        """The same, unpacked. Raises BadPiece: it takes more, or is damaged."""
        if not self.packed:
            return self
        tag, body = next(_elements(inflated(self.body, max_bytes), self.order), (0, self.body))
        if tag != MATRIX:
            raise BadPiece("a packed variable that is none")
        return _variable(body, self.order)[1]

    def data(self) -> Iterator[tuple[int, memoryview]]:
        """The elements behind its head."""
        return islice(_elements(self.body, self.order), 3, None)

    def numbers(self) -> np.ndarray:
        """Its numbers, as float64 in one dimension.

        Raises BadPiece: not real numbers in a row or a column, or not all there.
        """
        if self.kind not in NUMERIC:
            raise BadPiece(f"{KINDS.get(self.kind, 'no numbers')}. {OBJECTS}")
        if self.is_complex:
            raise BadPiece("complex numbers. Give real ones.")
        if max(self.shape, default=0) != self.size or self.size > LARGEST_ROWS:
            message = f"{'×'.join(map(str, self.shape))} numbers. Give one row or column of at most {LARGEST_ROWS}."
            raise BadPiece(message)
        here = self.unpacked(8 * self.size + HEAD_BYTES)
        tag, data = next(here.data(), (0, b""))
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
        here = self.unpacked()
        if here.kind == CHAR:
            return here._rows()
        texts = []
        for cell in _matrices(here.data(), here.size, here.order):
            if cell.kind != CHAR:
                raise BadPiece(f"a cell array with {KINDS.get(cell.kind, 'something')} in it. Give texts only.")
            texts.append("".join(cell._rows()[:1]))
        return texts

    def _rows(self) -> list[str]:
        """The rows of a character array, without blanks behind."""
        if self.size == 0:
            return []
        tag, data = next(self.data(), (0, b""))
        codec = TEXTS.get(tag)
        if codec is None or len(self.shape) != 2 or self.size > LARGEST_ROWS or self.shape[1] > LONGEST_TEXT:
            raise BadPiece("texts that are none")
        order = {"<": "-le", ">": "-be"}[self.order] if codec in ("utf-16", "utf-32") else ""
        text = bytes(data).decode(codec + order, "replace")
        rows, length = self.shape
        if len(text) < self.size:
            raise BadPiece("texts that are declared and not there")
        return [text[row : rows * length : rows].rstrip() for row in range(rows)]

    def fields(self) -> dict[str, Variable]:
        """The fields of an unpacked struct of one element. Raises BadPiece: damaged."""
        data = self.data()
        (_, length), (_, names) = next(data, (0, b"")), next(data, (0, b""))
        each = int.from_bytes(length[:4], "little" if self.order == "<" else "big")
        if not 0 < each <= 64 or len(names) % each or len(names) > each * MOST_FIELDS:
            raise BadPiece("names of fields that are none")
        titles = [_name(bytes(names[at : at + each])) for at in range(0, len(names), each)]
        return dict(zip(titles, _matrices(data, len(titles), self.order), strict=True))


def _variable(body: memoryview, order: str, packed: memoryview | None = None) -> tuple[str, Variable]:
    """Name and head of a variable from its elements; what follows its name stays closed."""
    head = [bytes(data) for _, data in islice(_elements(body, order), 3)]
    if len(head) < 3 or len(head[0]) != 8 or len(head[1]) not in range(8, 36, 4) or len(head[2]) > 64:
        raise BadPiece("a variable without a head")
    (flags, _), shape = struct.unpack(order + "II", head[0]), np.frombuffer(head[1], order + "i4")
    if shape.min() < 0:
        raise BadPiece("a variable of less than nothing")
    is_complex, inside = bool(flags & COMPLEX), body if packed is None else packed
    return _name(head[2]), Variable(flags & 0xFF, tuple(shape.tolist()), is_complex, inside, order, packed is not None)


def _matrices(data: Iterator[tuple[int, memoryview]], count: int, order: str) -> Iterator[Variable]:
    """The variables of so many elements: cells of an array, or fields of a struct."""
    for _ in range(count):
        tag, body = next(data, (0, memoryview(b"")))
        if tag != MATRIX:
            raise BadPiece("a cell or field that is no variable")
        yield _variable(body, order)[1] if len(body) else Variable(6, (0, 0), False, body, order)


def _name(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("ascii", "replace")


def variables(content: bytes, name: str) -> dict[str, Variable]:
    """The variables of a MAT file by name, none of them unpacked further than its head.

    Raises BadRecord: no MAT file of version 5 to 7, or damaged.
    """
    order = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}.get(content[124:HEADER_BYTES])
    if order is None:
        what = "a MAT file of version 7.3" if content.startswith(b"MATLAB 7.3") else "no MAT file of version 5 to 7"
        raise BadRecord(what, place=name, fix=FIX)
    by_name: dict[str, Variable] = {}
    tag_of_matrix = struct.pack(order + "I", MATRIX)
    try:
        for count, (tag, body) in enumerate(_elements(memoryview(content)[HEADER_BYTES:], order)):
            if tag == MATRIX:
                title, by_name[title] = _variable(body, order)
            elif tag == PACKED and (head := inflated(body, HEAD_BYTES, whole=False))[:4] == tag_of_matrix:
                title, by_name[title] = _variable(head[8:], order, packed=body)
            if count >= MOST_VARIABLES:  # those without a name, or with one that was there before, count too
                raise BadPiece(f"more than {MOST_VARIABLES} variables")
    except BadPiece as error:
        raise BadRecord(f"a damaged MAT file ({error})", place=name, fix=FIX) from error
    return {title: variable for title, variable in by_name.items() if title}


def read_mat(content: bytes, path: Path, column_map: ColumnMap) -> Table:
    """Read a table from the bytes of a MAT file; `path` names it in messages, `column_map` is the parsed `--map`.

    Raises BadRecord: with the file and the variable, and what to do.
    """
    name = str(path)
    top = variables(content, name)
    if not top:
        raise BadRecord("no variable", place=name, fix=FIX)
    named = top if columns.complete(columns.places(list(top), column_map)) else _with_fields(top, name)
    full_names, column_map = _in_scope(named, column_map, name)
    header = sorted(full_names, key=lambda title: named[full_names[title]].size < 2)  # messages name columns first
    known = columns.columns(header, column_map, [], name)
    of = {target: full_names[header[column.index]] for target, column in known.items()}
    numbers: dict[str, np.ndarray] = {}
    segment_names: list[str] = []
    for target, title in of.items():
        with _naming_place(f"{name}, {title}"):
            if target == "segment":
                numbers[target], segment_names = _segments(named[title], f"{name}, {title}")
            else:
                numbers[target] = named[title].numbers()
    size = numbers["time_s"].size
    for target, values in numbers.items():
        if target == "segment" and values.size == 1:
            numbers[target] = np.repeat(values, size)
        elif target != "pulse_rate_hz" and values.size != size:
            message = f"{values.size} {'names' if target == 'segment' else 'numbers'} for {size} samples"
            raise BadRecord(message, place=f"{name}, {of[target]}", fix="Give one for each sample.")
    if not size:
        raise BadRecord("no number", place=f"{name}, {of['time_s']}", fix="Give a few seconds of data.")
    return Table.of(content, path, known, numbers, segment_names, cell=lambda row, column: f"{of[column]}({row + 1})")


def _with_fields(top: Mapping[str, Variable], name: str) -> dict[str, Variable]:
    """Variables and fields of structs, of whatever depth, by name: `data.stim.pw`."""
    named: dict[str, Variable] = {}
    waiting, left = list(top.items()), LARGEST_FILE_BYTES
    while waiting:
        title, variable = waiting.pop(0)
        if variable.kind != STRUCT or variable.size != 1 or title.count(".") >= DEEPEST:
            named[title] = variable
            continue
        with _naming_place(f"{name}, {title}", FIX):
            left -= len((variable := variable.unpacked(left)).body) if variable.packed else 0
            waiting += [(f"{title}.{field}", inner) for field, inner in variable.fields().items()]
        if len(named) + len(waiting) > MOST_VARIABLES:
            raise BadRecord(f"more than {MOST_VARIABLES} variables", place=name, fix=FIX)
    return named


def _in_scope(named: Mapping[str, Variable], column_map: ColumnMap, name: str) -> tuple[dict[str, str], ColumnMap]:
    """Full names by the names within the struct that has the columns, and `--map` relative to it."""
    scopes = {}
    for prefix in dict.fromkeys(["", *(title.rpartition(".")[0] + "." for title in named if "." in title)]):
        inside = {title.removeprefix(prefix): title for title in named if title.startswith(prefix)}
        inside |= {title: title for title in named if title not in inside and not title.startswith(prefix)}
        relative = {target: text.removeprefix(prefix) for target, text in column_map.items()}
        if not prefix or columns.complete(columns.places(list(inside), relative)):
            scopes[prefix] = inside, relative
    full_names, _ = scopes[""]
    if len(scopes) == 1 or columns.complete(columns.places(list(full_names), column_map)):
        return scopes[""]
    _, scope, *others = scopes
    if others:
        both = " and ".join(prefix.rstrip(".") for prefix in (scope, *others))
        raise BadRecord(f"records in {both}", place=name, fix="Save each in a file of its own.")
    return scopes[scope]


@contextmanager
def _naming_place(place: str, fix: str = "") -> Iterator[None]:
    """Raise a BadPiece of the block as a BadRecord with the place."""
    try:
        yield
    except BadPiece as error:
        raise BadRecord(str(error).rstrip("."), place=place, fix=fix) from error


def _segments(variable: Variable, place: str) -> tuple[np.ndarray, list[str]]:
    """The code of each name, and the names by code."""
    texts = variable.texts() if variable.kind in (CHAR, CELL) else [f"{code:g}" for code in variable.numbers()]
    codes: dict[str, int] = {}
    code = np.array([codes.setdefault(text.strip(), len(codes)) for text in texts], np.int64)
    bounds.check_names(list(codes), place)
    return code, list(codes)

"""A table from a MAT file (versions 5 to 7): variables and fields of structs, named as the columns of a table.

A MAT file may declare a terabyte in a few bytes, unpack to one, and hold objects and function handles. `scipy.io` takes
memory for what is declared before it looks whether it is there, and ends the process at some damaged files; here each
bound is checked first, and only variables that are asked for are unpacked."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
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
NUMBERS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}
TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16-le", 16: "utf-8", 17: "utf-16-le", 18: "utf-32-le"}
MATRIX, PACKED = 14, 15
CELL, STRUCT, CHAR = 1, 2, 4
NUMERIC = range(6, 16)
COMPLEX = 0x0800
KINDS = {3: "an object", 5: "a sparse matrix", 16: "a function handle", 17: "an object (table, string, datetime, …)"}
MOST_VARIABLES, MOST_FIELDS, DEEPEST = 10_000, 1000, 8
FIX = "Save plain columns of numbers from MATLAB: save('record.mat', 'time_s', 'pulse_width_us', 'torque_nm', '-v7')."
OBJECTS = "Turn it into plain numbers or texts first: seconds(t), cellstr(s), table2struct(T, 'ToScalar', true)."
Element = tuple[int, memoryview]
"""Tag and data."""
NOTHING: Element = (0, memoryview(b""))


class BadPiece(Exception):
    """A piece of a file that is not what it is declared to be."""


@contextmanager
def _naming_place(place: str, fix: str = "") -> Iterator[None]:
    """Raise a BadPiece of the block as a BadRecord with the place."""
    try:
        yield
    except BadPiece as error:
        raise BadRecord(str(error).rstrip("."), place=place, fix=fix) from error


def _elements(view: memoryview) -> Iterator[Element]:
    """Each element that stands in these bytes."""
    place = 0
    while place + 8 <= len(view):
        tag, size = struct.unpack_from("<II", view, place)
        short = tag >> 16  # up to four bytes stand in the tag itself
        begin, end = (place + 4, place + 4 + short) if short else (place + 8, place + 8 + size)
        after = place + 8 if short else end if tag == PACKED else end + -size % 8
        if end > (after if short else len(view)):
            raise BadPiece("it ends within a variable")
        yield tag & 0xFFFF, view[begin:end]
        place = after


def _inflated(data: memoryview, max_bytes: int, whole: bool = True) -> memoryview:
    """Unpack zlib data of at most `max_bytes`; `whole`: there is no more."""
    packer = zlib.decompressobj()
    try:
        unpacked = packer.decompress(data, max_bytes)
    except zlib.error as error:
        raise BadPiece("packed data that do not unpack") from error
    if whole and not packer.eof:
        raise BadPiece("packed data that are damaged, or longer than any record")
    return memoryview(unpacked)


class Variable(NamedTuple):
    """A variable by its head; its data are not read yet. Raises BadPiece: they are not what is declared."""

    name: str
    kind: int  # MATLAB's class
    shape: tuple[int, ...]  # its dimensions, as declared
    is_complex: bool
    body: memoryview  # its elements, head included; packed: the whole variable as it is in the file
    is_packed: bool = False

    @classmethod
    def of(cls, tag: int, body: memoryview) -> Variable:
        """From an element of a file; of a packed one, no more is unpacked than its head."""
        if tag == PACKED:
            head = _inflated(body, HEAD_BYTES, whole=False)
            inner = cls.of(int.from_bytes(head[:4], "little"), head[8:]) if len(head) >= 8 else None
            return cls("", 0, (), False, body) if inner is None else inner._replace(body=body, is_packed=True)
        if tag != MATRIX or not len(body):
            return cls("", 6 if tag == MATRIX else 0, (0, 0), False, body)
        head = [bytes(data) for _, data in islice(_elements(body), 3)]
        if len(head) < 3 or len(head[0]) != 8 or len(head[1]) not in range(8, 36, 4) or len(head[2]) > 64:
            raise BadPiece("a variable without a head")
        flags, shape = int.from_bytes(head[0][:4], "little"), np.frombuffer(head[1], "<i4")
        if shape.min() < 0:
            raise BadPiece("a variable of less than nothing")
        return cls(_name(head[2]), flags & 0xFF, tuple(shape.tolist()), bool(flags & COMPLEX), body)

    @property
    def size(self) -> int:
        """Number of elements, as declared."""
        return math.prod(self.shape)

    def unpacked(self, max_bytes: int = LARGEST_FILE_BYTES) -> Variable:
        """The same, unpacked, if it takes no more."""
        return self.of(*next(_elements(_inflated(self.body, max_bytes)), NOTHING)) if self.is_packed else self

    def _data(self) -> Iterator[Element]:
        """The elements behind its head."""
        return islice(_elements(self.body), 3, None)

    def _inner(self, data: Iterator[Element], count: int) -> list[Variable]:
        """The variables of so many elements: cells of an array, or fields of a struct."""
        inner = [(tag, body) for tag, body in islice(data, count) if tag == MATRIX]
        if len(inner) < count:
            raise BadPiece("a cell or field that is no variable")
        return [self.of(*element) for element in inner]

    def numbers(self) -> np.ndarray:
        """Its numbers, as float64 in one dimension: real ones, in a row or a column."""
        if self.kind not in NUMERIC:
            raise BadPiece(f"{KINDS.get(self.kind, 'no numbers')}. {OBJECTS}")
        if self.is_complex:
            raise BadPiece("complex numbers. Give real ones.")
        if max(self.shape, default=0) != self.size or self.size > LARGEST_ROWS:
            message = f"{'×'.join(map(str, self.shape))} numbers. Give one row or column of at most {LARGEST_ROWS}."
            raise BadPiece(message)
        here = self.unpacked(8 * self.size + HEAD_BYTES)
        tag, data = next(here._data(), NOTHING)
        if tag not in NUMBERS or len(data) != here.size * np.dtype(NUMBERS[tag]).itemsize:
            raise BadPiece("numbers that are declared and not there")
        return np.frombuffer(data, NUMBERS[tag]).astype(float)

    def texts(self) -> list[str]:
        """Its texts: of a cell array each element's, of a character array each row's, without blanks behind."""
        if self.kind not in (CHAR, CELL):
            raise BadPiece(f"{KINDS.get(self.kind, 'no texts')}. {OBJECTS}")
        if self.size > LARGEST_ROWS:
            raise BadPiece(f"{self.size} texts. At most {LARGEST_ROWS} are read.")
        here = self.unpacked()
        if here.kind == CELL:
            cells = here._inner(here._data(), here.size)
            if other := next((cell for cell in cells if cell.kind != CHAR), None):
                raise BadPiece(f"a cell array with {KINDS.get(other.kind, 'something')} in it. Give texts only.")
            return ["".join(cell.texts()[:1]) for cell in cells]
        if here.size == 0:
            return []
        tag, data = next(here._data(), NOTHING)
        if tag not in TEXTS or len(here.shape) != 2 or here.size > LARGEST_ROWS or here.shape[1] > LONGEST_TEXT:
            raise BadPiece("texts that are none")
        text = bytes(data).decode(TEXTS[tag], "replace")
        rows, length = here.shape
        if len(text) < here.size:
            raise BadPiece("texts that are declared and not there")
        return [text[row : rows * length : rows].rstrip() for row in range(rows)]

    def fields(self) -> dict[str, Variable]:
        """The fields of an unpacked struct of one element."""
        data = self._data()
        (_, length), (_, names) = next(data, NOTHING), next(data, NOTHING)
        each = int.from_bytes(length[:4], "little")
        if not 0 < each <= 64 or len(names) % each or len(names) > each * MOST_FIELDS:
            raise BadPiece("names of fields that are none")
        titles = [_name(bytes(names[at : at + each])) for at in range(0, len(names), each)]
        return dict(zip(titles, self._inner(data, len(titles)), strict=True))


def _name(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("ascii", "replace")


def variables(content: bytes, name: str) -> dict[str, Variable]:
    """The variables of a MAT file by name, none of them unpacked further than its head.

    Raises BadRecord: no MAT file of version 5 to 7, or damaged.
    """
    if content[124:HEADER_BYTES] != b"\x00\x01IM":
        what = "a MAT file of version 7.3" if content.startswith(b"MATLAB 7.3") else "no MAT file of version 5 to 7"
        raise BadRecord(what, place=name, fix=FIX)
    by_name: dict[str, Variable] = {}
    with _naming_place(name, FIX):
        for count, element in enumerate(_elements(memoryview(content)[HEADER_BYTES:])):
            variable = Variable.of(*element)
            by_name[variable.name] = variable
            if count >= MOST_VARIABLES:  # those without a name, or with one that was there before, count too
                raise BadPiece(f"more than {MOST_VARIABLES} variables")
    by_name.pop("", None)
    if not by_name:
        raise BadRecord("no variable", place=name, fix=FIX)
    return by_name


def read_mat(content: bytes, path: Path, column_map: ColumnMap) -> Table:
    """Read a table from the bytes of a MAT file; `path` names it in messages, `column_map` is the parsed `--map`.

    Raises BadRecord: with the file and the variable, and what to do.
    """
    name = str(path)
    prefix, known, column_map = _find_columns(variables(content, name), column_map, name)
    header = sorted(known, key=lambda title: known[title].size < 2)  # messages name columns first
    mapped = columns.columns(header, column_map, [], f"{name}, {prefix.rstrip('.')}" if prefix else name)
    of = {target: prefix + header[column.index] for target, column in mapped.items()}
    numbers: dict[str, np.ndarray] = {}
    segment_codes: dict[str, int] = {}
    for target, column in mapped.items():
        variable, place = known[header[column.index]], f"{name}, {of[target]}"
        with _naming_place(place):
            if target != "segment":
                numbers[target] = variable.numbers()
                continue
            texts = variable.texts() if variable.kind not in NUMERIC else [f"{code:g}" for code in variable.numbers()]
        codes = [segment_codes.setdefault(text.strip(), len(segment_codes)) for text in texts]
        bounds.check_names(list(segment_codes), place)
        numbers[target] = np.array(codes * numbers["time_s"].size if len(codes) == 1 else codes, np.int64)
    size = numbers["time_s"].size
    for target, values in numbers.items():
        if target != "pulse_rate_hz" and values.size != size:
            message = f"{values.size} {'names' if target == 'segment' else 'numbers'} for {size} samples"
            raise BadRecord(message, place=f"{name}, {of[target]}", fix="Give one for each sample.")
    if not size:
        raise BadRecord("no number", place=f"{name}, {of['time_s']}", fix="Give a few seconds of data.")
    return Table.of(
        content, path, mapped, numbers, list(segment_codes), cell=lambda row, column: f"{of[column]}({row + 1})"
    )


Scope = tuple[str, dict[str, Variable], ColumnMap]
"""A struct's name with a point behind; variables by their names in it; and what `--map` says of these."""


def _find_columns(top: dict[str, Variable], column_map: ColumnMap, name: str) -> Scope:
    """The variables themselves, or the struct whose fields, of whatever depth, are the columns."""
    if columns.places(list(top), column_map).keys() >= set(columns.NEEDED):
        return "", top, column_map
    waiting, named, left = list(top.items()), {}, LARGEST_FILE_BYTES
    while waiting:
        title, variable = waiting.pop(0)
        if variable.kind != STRUCT or variable.size != 1 or title.count(".") >= DEEPEST:
            named[title] = variable
            continue
        with _naming_place(f"{name}, {title}", FIX):
            opened = variable.unpacked(left)
            left -= len(opened.body) if variable.is_packed else 0
            waiting += [(f"{title}.{field}", inner) for field, inner in opened.fields().items()]
        if len(named) + len(waiting) > MOST_VARIABLES:
            raise BadRecord(f"more than {MOST_VARIABLES} variables", place=name, fix=FIX)
    scopes: list[Scope] = []
    for prefix in dict.fromkeys(["", *(title.rpartition(".")[0] + "." for title in named if "." in title)]):
        inside = {title.removeprefix(prefix): variable for title, variable in named.items() if title.startswith(prefix)}
        relative = {target: text.removeprefix(prefix) for target, text in column_map.items()}
        if columns.places(list(inside), relative).keys() >= set(columns.NEEDED):
            scopes.append((prefix, inside, relative))
    if len(scopes) > 1 and scopes[0][0]:
        both = " and ".join(prefix.rstrip(".") for prefix, *_ in scopes)
        raise BadRecord(f"records in {both}", place=name, fix="Save each in a file of its own.")
    return scopes[0] if scopes else ("", named, column_map)

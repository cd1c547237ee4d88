"""The strict reader of HDF5 files: numbers and names that stand in the file itself, and nothing else.

An HDF5 file may name other files (external storage, external and soft links, virtual datasets), declare a terabyte in a
few bytes, or carry code's input in unusual types. So libhdf5 is asked only how a dataset is laid out, of a copy in
memory. The numbers are then taken from the file's own bytes, each bound checked before memory is taken for it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import h5py
import numpy as np
from h5py import h5a, h5d, h5f, h5g, h5l, h5o, h5s, h5t, h5z  # pyright: ignore[reportAttributeAccessIssue]

from stimrig.identify.errors import BadRecord
from stimrig.identify.records.bounds import LARGEST_ROWS, LONGEST_PLAN, LONGEST_TEXT, MOST_SEGMENTS, BadPiece, inflated

LARGEST_CHUNK_BYTES = 16 * 2**20
MOST_CHUNKS = 100_000
OVERHEAD_BYTES = 4096
"""What a filter may add to what cannot be packed."""


class BadChunk(BadPiece):
    """A piece of a dataset that is not what it is declared to be."""


def file_piece(content: bytes, offset: int | None, size: int) -> memoryview:
    """A stretch of the file. Raises BadChunk: it was never written, or lies outside."""
    if offset is None:
        raise BadChunk("values are declared and were never written")
    if not (offset >= 0 and offset + size <= len(content)):
        raise BadChunk("values are declared beyond the file's end")
    return memoryview(content)[offset : offset + size]


def read_chunks(
    content: bytes, dataset: Any, length: int, filters: Sequence[int], dtype: np.dtype, size: int
) -> np.ndarray:
    """The values of a dataset in chunks of `length` values, each chunk written.

    Raises BadChunk: too large, too many, not written, or not what was declared.
    """
    full = length * dtype.itemsize
    count = -(-size // length)
    if not (0 < full <= LARGEST_CHUNK_BYTES):
        raise BadChunk(f"chunks of {full} bytes, at most {LARGEST_CHUNK_BYTES} are read")
    if count > MOST_CHUNKS:
        raise BadChunk(f"{count} chunks, at most {MOST_CHUNKS} are read")
    values = np.empty(size, dtype)
    for start in range(0, size, length):
        stored = dataset.get_chunk_info_by_coord((start,))
        if stored.size > full + OVERHEAD_BYTES:
            raise BadChunk("a chunk that is larger than what it holds")
        packed = file_piece(content, stored.byte_offset, stored.size)
        chunk = np.frombuffer(unpacked(packed, filters, stored.filter_mask, dtype.itemsize, full), dtype)
        values[start : start + length] = chunk[: size - start]
    return values


def unpacked(data: Any, filters: Sequence[int], skipped: int, itemsize: int, full: int) -> Any:
    """A chunk's bytes with its filters undone, the last one first.

    Raises BadChunk: they do not give the chunk's size, or a checksum does not hold.
    """
    for index in reversed(range(len(filters))):
        if skipped >> index & 1:
            continue
        if filters[index] == h5z.FILTER_DEFLATE:
            data = inflated(data, full + OVERHEAD_BYTES, "packed data that are damaged, or longer than declared")
        elif filters[index] == h5z.FILTER_SHUFFLE:
            data = np.frombuffer(data, np.uint8, len(data) // itemsize * itemsize).reshape(itemsize, -1).T.tobytes()
        else:
            data, stored = data[:-4], np.frombuffer(bytes(data[-4:]).ljust(4, b"\0"), "<u2")
            if fletcher32(data) != (int(stored[0]) % 65535, int(stored[1]) % 65535):
                raise BadChunk("a checksum does not hold; the file was damaged")
    if len(data) != full:
        raise BadChunk("a chunk that does not unpack to its size")
    return data


def fletcher32(data: Any) -> tuple[int, int]:
    """Both sums of HDF5's checksum over words of two bytes, modulo 65535."""
    even = bytes(data) + b"\0" * (len(data) % 2)
    words = np.frombuffer(even, ">u2").astype(np.uint64)
    second = int(np.sum(words * np.arange(words.size, 0, -1, dtype=np.uint64))) if words.size else 0
    return int(words.sum()) % 65535, second % 65535


FIX = "Give a sealed recording, as written by the rig at the end of a test."
ELSEWHERE = object()
FILTERS = (h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32)


class StrictFile:
    """An HDF5 file that somebody else may have made, opened from its bytes.

    `content`: the whole file; `name`: how messages call it.
    """

    def __init__(self, content: bytes, name: str) -> None:
        self.content, self.name = content, name
        with self._asking(""):
            self._file = h5f.open_file_image(content)
            self._root = h5g.open(self._file, b"/")

    def text(self, name: str, default: str | None = None, longest: int = LONGEST_TEXT) -> str:
        """A text attribute of the root. Raises BadRecord: not there and no default, no text, or longer."""
        value = self._attribute(name, default)
        if not isinstance(value, str | bytes) or len(value) > longest:
            raise self.bad("no text, or one without an end", f"attribute {name}")
        return _sound(value)

    def number(self, name: str, default: float) -> float:
        """A numeric attribute of the root; NaN where it holds something else."""
        value = self._attribute(name, default)
        return float(value) if isinstance(value, int | float | np.number) else float("nan")

    def has(self, path: str) -> bool:
        """Whether something is called so; what it is, `numbers` says."""
        return self._find(path) is not None

    def _find(self, path: str) -> Any:
        """What hard links alone lead to: None where nothing is called so, `ELSEWHERE` at another kind of link."""
        here: Any = self._root
        with self._asking(path):
            for part in path.strip("/").encode().split(b"/"):
                if not isinstance(here, h5g.GroupID) or not here.links.exists(part):
                    return None
                if here.links.get_info(part).type != h5l.TYPE_HARD:
                    return ELSEWHERE
                here = h5o.open(here, part)
        return here

    def numbers(self, path: str) -> np.ndarray:
        """A dataset of one dimension as float64.

        Raises BadRecord: not there, not inside the file, not plain numbers, or longer than any record.
        """
        dataset = self._dataset(path)
        with self._asking(path):
            kind = dataset.get_type()
            plain = kind.get_class() in (h5t.INTEGER, h5t.FLOAT) and kind.get_size() <= 8
            if not plain or h5t.py_create(kind.dtype) != kind:
                raise self.bad("no plain numbers", path)
            size = self._size(dataset, path, LARGEST_ROWS)
            return np.asarray(self._values(dataset, path, kind.dtype, size), float)

    def columns(self, group: str, names: Sequence[str], unequal: str) -> list[np.ndarray]:
        """The datasets of a group, equally long, as float64. Raises BadRecord: as for `numbers`, or `unequal`."""
        found = [self.numbers(f"{group}/{name}") for name in names]
        if len({column.size for column in found}) > 1:
            raise self.bad(unequal, group)
        return found

    def names(self, path: str) -> list[str]:
        """A dataset of one dimension of texts. Raises BadRecord: as for `numbers`."""
        dataset = self._dataset(path)
        with self._asking(path):
            kind = dataset.get_type()
            if kind.get_class() != h5t.STRING:
                raise self.bad("no texts", path)
            size = self._size(dataset, path, MOST_SEGMENTS)
            if not kind.is_variable_str():
                if kind.get_size() > LONGEST_TEXT:
                    raise self.bad("texts without an end", path)
                values = self._values(dataset, path, np.dtype(f"S{kind.get_size()}"), size)
                return [_sound(bytes(value)) for value in values]
            if dataset.get_create_plist().get_nfilters():
                raise self.bad("compressed texts", path)
            return [self._variable_text(dataset, index, path) for index in range(size)]

    def _variable_text(self, dataset: Any, index: int, path: str) -> str:
        """One text by itself: many elements may point to one long text, which is then read once and refused."""
        selection = dataset.get_space()
        selection.select_hyperslab((index,), (1,))
        found = np.empty(1, h5py.string_dtype())
        dataset.read(h5s.create_simple((1,)), selection, found)
        if len(found[0]) > LONGEST_TEXT:
            raise self.bad("a text without an end", path)
        return _sound(found[0])

    def _attribute(self, name: str, default: Any) -> Any:
        with self._asking(f"attribute {name}"):
            if not h5a.exists(self._file, name.encode()):
                if default is None:
                    raise self.bad("is missing", f"attribute {name}")
                return default
            attribute = h5a.open(self._file, name.encode())
            kind = attribute.get_type()
            known = kind.get_class() in (h5t.STRING, h5t.INTEGER, h5t.FLOAT) and kind.get_size() <= LONGEST_PLAN
            if not known or attribute.get_space().get_simple_extent_type() != h5s.SCALAR:
                raise self.bad("no single number or text", f"attribute {name}")
            return h5py.File(self._file).attrs[name]

    def _dataset(self, path: str) -> Any:
        """The dataset of a path, its data inside this file."""
        here = self._find(path)
        if here is None:
            raise self.bad(f"incomplete recording (no {path})")
        if here is ELSEWHERE:
            raise self.bad("a link to somewhere else", path)
        with self._asking(path):
            if not isinstance(here, h5d.DatasetID):
                raise self.bad("no dataset", path)
            plan = here.get_create_plist()
            if plan.get_layout() not in (h5d.CONTIGUOUS, h5d.CHUNKED) or plan.get_external_count():
                raise self.bad("data that are not plainly in this file (virtual or external)", path)
            return here

    def _size(self, dataset: Any, path: str, most: int) -> int:
        space = dataset.get_space()
        if space.get_simple_extent_type() != h5s.SIMPLE or space.get_simple_extent_ndims() != 1:
            raise self.bad("not of one dimension", path)
        (size,) = space.get_simple_extent_dims()
        if not (0 <= size <= most):
            raise self.bad(f"{size} values are declared, at most {most} are read", path)
        return int(size)

    def _values(self, dataset: Any, path: str, dtype: np.dtype, size: int) -> np.ndarray:
        """The values, from the file's own bytes."""
        if size == 0:
            return np.empty(0, dtype)
        plan = dataset.get_create_plist()
        try:
            if plan.get_layout() == h5d.CONTIGUOUS:
                piece = file_piece(self.content, dataset.get_offset(), size * dtype.itemsize)
                return np.frombuffer(piece, dtype)
            filters = [plan.get_filter(index)[0] for index in range(plan.get_nfilters())]
            if unknown := [number for number in filters if number not in FILTERS]:
                raise self.bad(f"a filter (number {unknown[0]}) other than gzip, shuffle and fletcher32", path)
            return read_chunks(self.content, dataset, plan.get_chunk()[0], filters, dtype, size)
        except BadPiece as error:
            raise self.bad(str(error), path) from error

    @contextmanager
    def _asking(self, path: str) -> Iterator[None]:
        """Whatever libhdf5 or h5py raises at a damaged file, as one line."""
        try:
            yield
        except BadRecord:
            raise
        except Exception as error:
            raise self.bad("unreadable or half-written HDF5", path) from error

    def bad(self, message: str, path: str = "") -> BadRecord:
        """The error that says what is wrong with the file, or with what stands in it at a path."""
        return BadRecord(message, place=f"{self.name}, {path}" if path else self.name, fix=FIX)


def _sound(text: str | bytes) -> str:
    """Text that can be written anywhere, whatever its bytes were."""
    raw = text if isinstance(text, bytes) else text.encode("utf-8", "surrogateescape")
    return raw.decode("utf-8", "replace")

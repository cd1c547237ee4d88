"""The strict reader of HDF5 files: numbers and names that stand in the file itself, and nothing else.

An HDF5 file may name other files (external storage, external and soft links, virtual datasets), declare a terabyte in a
few bytes, or hold unusual types. So each dataset is asked where its values are and how large they are before h5py reads
it, of a copy in memory."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import h5py
import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records.bounds import LARGEST_ROWS, LONGEST_PLAN, LONGEST_TEXT, MOST_SEGMENTS

LARGEST_CHUNK_BYTES = 2**20
"""Packed it may be a thousandth of it, and libhdf5 unpacks it whole, whatever it was declared to be."""
MOST_CHUNKS = 100_000
HEAP, MOST_OBJECTS = b"GCOL\x01", 1_000_000
"""With what a heap of texts begins; objects in all of them."""
OVERHEAD_BYTES = 4096
"""Bytes that a filter may add to data that it cannot compress."""
FIX = "Give a sealed recording, as written by the rig at the end of a test."


class StrictFile:
    """An HDF5 file that somebody else may have made, opened from its bytes.

    `content`: the whole file; `name`: how messages call it.
    """

    def __init__(self, content: bytes, name: str) -> None:
        self.name = name
        if not _heaps_end(content):
            raise self.bad("unreadable or half-written HDF5")
        with self._asking(""):
            self._file = h5py.File(io.BytesIO(content), "r")

    def bad(self, message: str, path: str = "") -> BadRecord:
        """The error that says what is wrong with the file, or with what stands in it at a path."""
        return BadRecord(message, place=f"{self.name}, {path}" if path else self.name, fix=FIX)

    @contextmanager
    def _asking(self, path: str) -> Iterator[None]:
        """Raise any error of libhdf5 or h5py at a damaged file as a BadRecord of one line."""
        try:
            yield
        except BadRecord:
            raise
        except Exception as error:
            raise self.bad("unreadable or half-written HDF5", path) from error

    def text(self, name: str, default: str | None = None) -> str:
        """A text attribute of the root. Raises BadRecord: not there and no default, no text, or longer."""
        value = self._attribute(name, default)
        if not isinstance(value, str | bytes) or len(value) > LONGEST_TEXT:
            raise self.bad("no text, or one without an end", f"attribute {name}")
        return _sound(value)

    def number(self, name: str, default: float) -> float:
        """A numeric attribute of the root; NaN where it holds something else."""
        value = self._attribute(name, default)
        return float(value) if isinstance(value, int | float | np.number) else float("nan")

    def _attribute(self, name: str, default: Any) -> Any:
        path = f"attribute {name}"
        with self._asking(path):
            attributes = self._file.attrs
            if name not in attributes:
                if default is None:
                    raise self.bad("is missing", path)
                return default
            attribute = attributes.get_id(name)
            known = h5py.check_string_dtype(attribute.dtype) is not None or attribute.dtype.kind in "iufS"
            if not known or attribute.shape != () or attribute.dtype.itemsize > LONGEST_PLAN:
                raise self.bad("no single number or text", path)
            return attributes[name]

    def has(self, path: str) -> bool:
        """Return true if the path exists; its kind is not checked."""
        with self._asking(path):
            return path in self._file

    def columns(self, group: str, names: Sequence[str]) -> list[np.ndarray]:
        """The datasets of a group, equally long, as float64. Raises BadRecord: as for `numbers`, or not so."""
        arrays = [self.numbers(f"{group}/{name}") for name in names]
        if len({column.size for column in arrays}) > 1:
            raise self.bad(f"{', '.join(names)} differ in number", group)
        return arrays

    def numbers(self, path: str) -> np.ndarray:
        """A dataset of one dimension as float64.

        Raises BadRecord: not there, not inside the file, not plain numbers, or longer than any record.
        """
        with self._asking(path):
            dataset = self._dataset(path, LARGEST_ROWS)
            if h5py.check_enum_dtype(dataset.dtype) or dataset.dtype.kind not in "iuf" or dataset.dtype.itemsize > 8:
                raise self.bad("no plain numbers", path)
            return dataset[:].astype(float)

    def names(self, path: str) -> list[str]:
        """A dataset of one dimension of texts. Raises BadRecord: as for `numbers`."""
        with self._asking(path):
            dataset = self._dataset(path, MOST_SEGMENTS)
            kind = h5py.check_string_dtype(dataset.dtype)
            if kind is None:
                raise self.bad("no texts", path)
            texts: list[str] = []
            for index in range(len(dataset)):  # many may point to one long text, which is then read once and refused
                text = b"" if (kind.length or 0) > LONGEST_TEXT else dataset[index]
                if not 0 < len(text) <= LONGEST_TEXT:
                    raise self.bad("a text that is empty or without an end", path)
                texts.append(_sound(text))
            return texts

    def _dataset(self, path: str, max_length: int) -> h5py.Dataset:
        """The dataset of a path: all of its values are written, and in this file. libhdf5 gives the fill value for
        those that are declared and were never written."""
        here: Any = self._file
        for part in path.strip("/").split("/"):
            link = here.get(part, getlink=True) if isinstance(here, h5py.Group) else None
            if link is None:
                raise self.bad(f"incomplete recording (no {path})")
            if not isinstance(link, h5py.HardLink):
                raise self.bad("a link to somewhere else", path)
            here = here[part]
        if not isinstance(here, h5py.Dataset):
            raise self.bad("no dataset", path)
        if here.is_virtual or here.external:
            raise self.bad("data that are not plainly in this file (virtual or external)", path)
        if here.shape is None or len(here.shape) != 1:
            raise self.bad("not of one dimension", path)
        if len(here) > max_length:
            raise self.bad(f"{len(here)} values are declared, at most {max_length} are read", path)
        if here.chunks is None:
            complete = here.id.get_storage_size() >= len(here) * here.dtype.itemsize
        else:
            (length,) = here.chunks
            full, count = length * here.dtype.itemsize, -(-len(here) // length)
            if full > LARGEST_CHUNK_BYTES or count > MOST_CHUNKS:
                raise self.bad(f"{count} chunks of {full} bytes: too many, or too large", path)
            written = [here.id.get_chunk_info(index).size for index in range(here.id.get_num_chunks())]
            if max(written, default=0) > full + OVERHEAD_BYTES:
                raise self.bad("a chunk that is larger than what it holds", path)
            complete = len(written) >= count
        if not complete:
            raise self.bad("values are declared and were never written", path)
        return here


def _heaps_end(content: bytes) -> bool:
    """Return false if the objects of a heap of texts do not fill it: libhdf5 follows such a list for ever."""
    begin, count = content.find(HEAP), 0
    while begin >= 0:
        place, end = begin + 16, begin + int.from_bytes(content[begin + 8 : begin + 16], "little")
        while place + 16 <= end:
            if end > len(content) or count > MOST_OBJECTS:
                return False
            index, size = struct.unpack_from("<H6xQ", content, place)
            if not index and size < 16:
                return False
            place += 16 + size + -size % 8 if index else size  # the free space counts its own head
            count += 1
        if place > end:
            return False
        begin = content.find(HEAP, begin + 1)
    return True


def _sound(text: str | bytes) -> str:
    """Text that can be written anywhere, whatever its bytes were."""
    raw = text if isinstance(text, bytes) else text.encode("utf-8", "surrogateescape")
    return raw.decode("utf-8", "replace")

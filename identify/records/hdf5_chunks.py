"""Bytes of an HDF5 dataset, taken from the file's content and unpacked with a bound on every step."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from h5py import h5z  # pyright: ignore[reportAttributeAccessIssue]

LARGEST_CHUNK_BYTES = 16 * 2**20
MOST_CHUNKS = 100_000
OVERHEAD_BYTES = 4096
"""What a filter may add to what cannot be packed."""


class BadChunk(Exception):
    """A piece of a dataset that is not what it is declared to be."""


def piece(content: bytes, offset: int | None, size: int) -> memoryview:
    """A stretch of the file.

    Raises
    ------
    BadChunk
        It was never written, or lies outside.
    """
    if offset is None:
        raise BadChunk("values are declared and were never written")
    if not (offset >= 0 and offset + size <= len(content)):
        raise BadChunk("values are declared beyond the file's end")
    return memoryview(content)[offset : offset + size]


def read(content: bytes, dataset: Any, length: int, filters: Sequence[int], dtype: np.dtype, size: int) -> np.ndarray:
    """The values of a dataset in chunks of `length` values, each chunk written.

    Raises
    ------
    BadChunk
        Too large, too many, not written, or not what was declared.
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
        packed = piece(content, stored.byte_offset, stored.size)
        chunk = np.frombuffer(unpacked(packed, filters, stored.filter_mask, dtype.itemsize, full), dtype)
        values[start : start + length] = chunk[: size - start]
    return values


def unpacked(data: Any, filters: Sequence[int], skipped: int, itemsize: int, full: int) -> Any:
    """A chunk's bytes with its filters undone, the last one first.

    Raises
    ------
    BadChunk
        They do not give the chunk's size, or a checksum does not hold.
    """
    for index in reversed(range(len(filters))):
        if skipped >> index & 1:
            continue
        if filters[index] == h5z.FILTER_DEFLATE:
            data = inflated(data, full + OVERHEAD_BYTES)
        elif filters[index] == h5z.FILTER_SHUFFLE:
            data = np.frombuffer(data, np.uint8, len(data) // itemsize * itemsize).reshape(itemsize, -1).T.tobytes()
        else:
            data, stored = data[:-4], np.frombuffer(bytes(data[-4:]).ljust(4, b"\0"), "<u2")
            if fletcher32(data) != (int(stored[0]) % 65535, int(stored[1]) % 65535):
                raise BadChunk("a checksum does not hold; the file was damaged")
    if len(data) != full:
        raise BadChunk("a chunk that does not unpack to its size")
    return data


def inflated(data: Any, most: int) -> bytes:
    """What gzip's filter packed, at most so many bytes.

    Raises
    ------
    BadChunk
        Damaged, or longer.
    """
    packer = zlib.decompressobj()
    try:
        found = packer.decompress(data, most)
    except zlib.error as error:
        raise BadChunk("packed data that do not unpack") from error
    if not packer.eof:
        raise BadChunk("packed data that are damaged, or longer than declared")
    return found


def fletcher32(data: Any) -> tuple[int, int]:
    """Both sums of HDF5's checksum over words of two bytes, modulo 65535."""
    even = bytes(data) + b"\0" * (len(data) % 2)
    words = np.frombuffer(even, ">u2").astype(np.uint64)
    second = int(np.sum(words * np.arange(words.size, 0, -1, dtype=np.uint64))) if words.size else 0
    return int(words.sum()) % 65535, second % 65535

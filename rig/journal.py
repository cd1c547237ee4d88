"""The journal: an append-only log of the test in blocks with length and CRC-32, written while it happens.

If the process is killed or the disk is full, at most the last block is lost. Blocks reach the kernel before `append`
returns (so they survive this process); they are synced to the disk at the start, twice a second and at the end.

Header and plan are needed to read the rest, so they are stored twice, further apart than one disk sector. The journal
is locked while it is open, so that nobody seals it while it is still being written.
"""

from __future__ import annotations

import contextlib
import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.errors import JournalError, RecordingError
from stimrig.rig.machine import Log
from stimrig.rig.signals import Segment

MAGIC = b"STIMRIG\x01"
_BLOCK = struct.Struct("<4sBxHII")
"""Mark, kind, (spare), sequence number (16 bits), length, CRC-32 over the fields before it and the payload."""
_LENGTH = struct.Struct("<I")
MARK = b"\xa5BLK"
_CRC_AT = 12
MAX_PAYLOAD = 64 * 1024 * 1024

INTENT = struct.Struct("<idddd")
"""Pulse index, time_s, due_s, width µs, current mA: written before the command goes out."""
WRITTEN = struct.Struct("<iBd")
"""Pulse index, packet number, time_s when the last byte was written to the line."""
SKIPPED = struct.Struct("<iBd")
"""Pulse index, `PulseStatus`, time_s."""
ACKED = struct.Struct("<id")
"""Pulse index (−1: not of this test), time_s; then the error's words in UTF-8, none when delivered."""


APART_BYTES = 8192
"""Between the two copies of header and plan: no damaged sector, 4096 bytes at most, reaches both."""


class Kind(IntEnum):
    """Content of a block."""

    HEADER = 1
    PLAN = 2
    START = 3
    INTENT = 4
    WRITTEN = 5
    SKIPPED = 6
    ACKED = 7
    TORQUE = 8
    EVENT = 9
    END = 10
    SPACER = 11
    EXTENSION = 12
    ANGLE = 13


@dataclass(frozen=True, slots=True)
class LaidBlock:
    """A segment that an adaptive test laid after its start; from `segment.start` it replaces what was laid before."""

    segment: Segment
    sequence: str
    settings: dict[str, Any]
    time_s: float
    pulse_width_us: NDArray[np.float64]

    def described(self) -> dict[str, Any]:
        return {**self.segment._asdict(), "sequence": self.sequence, "settings": self.settings, "time_s": self.time_s}

    def to_bytes(self) -> bytes:
        """Payload of a `Kind.EXTENSION` block."""
        described = json.dumps(self.described()).encode()
        return _LENGTH.pack(len(described)) + described + self.pulse_width_us.astype("<f8").tobytes()

    @staticmethod
    def from_bytes(payload: bytes) -> LaidBlock:
        start = _LENGTH.size + _LENGTH.unpack_from(payload)[0]
        content = json.loads(payload[_LENGTH.size : start])
        segment = Segment(content["name"], content["start"], content["end"], content["by"])
        widths_us = np.frombuffer(payload, "<f8", offset=start)
        return LaidBlock(segment, content["sequence"], content["settings"], content["time_s"], widths_us)


class Journal:
    """One test's journal, open for appending.

    After the first failure every further `append` raises: a journal with a gap must not look complete.

    Raises JournalError: the disk gives an error.
    """

    def __init__(self, log: Log) -> None:
        self.path = log.path
        self._log = log
        self._number = 0
        self._failure = ""
        self._written(lambda: log.append(MAGIC))

    def append(self, kind: Kind, payload: bytes) -> None:
        """Write one block through to the kernel. Raises JournalError: the disk gave an error, now or before."""
        head = _BLOCK.pack(MARK, kind, self._number & 0xFFFF, len(payload), 0)[:_CRC_AT]
        crc = zlib.crc32(payload, zlib.crc32(head))
        self._written(lambda: self._log.append(head + _LENGTH.pack(crc) + payload))
        self._number += 1

    def begin(self, header: dict[str, Any], plan: bytes) -> None:
        """Write header and plan, twice, and sync them to the disk. Raises JournalError."""
        for spacer in (bytes(APART_BYTES), b""):
            self.append_json(Kind.HEADER, header)
            self.append(Kind.PLAN, plan)
            if spacer:
                self.append(Kind.SPACER, spacer)
        self._written(self._log.sync)

    def append_json(self, kind: Kind, content: dict[str, Any]) -> None:
        self.append(kind, json.dumps(content).encode())

    def sync(self) -> None:
        """Sync everything written so far to the disk; may be called from elsewhere. Raises JournalError."""
        self._written(self._log.sync)

    def close(self) -> None:
        """Sync everything to the disk and close, also after an error; never raises."""
        with contextlib.suppress(OSError):
            self._log.close()

    def _written(self, action: Callable[[], None]) -> None:
        if self._failure:
            raise JournalError(self._failure)
        try:
            action()
        except OSError as error:
            self._failure = f"journal {self.path}: {error.strerror}; the test stops; what was written is kept"
            raise JournalError(self._failure) from None


@dataclass(frozen=True, slots=True)
class JournalContents:
    """Every complete block in order; `damaged_bytes` were skipped; `blocks_missing` are counted by sequence number."""

    path: Path
    blocks: list[tuple[Kind, bytes]]
    damaged_bytes: int
    blocks_missing: int

    @property
    def damaged(self) -> bool:
        """True where something cannot be read, or is missing."""
        return self.damaged_bytes > 0 or self.blocks_missing > 0

    @property
    def ended(self) -> bool:
        """True where the test's end was written: nothing is missing at the end."""
        return any(kind == Kind.END for kind, _ in self.blocks)

    def first_json(self, kind: Kind) -> dict[str, Any] | None:
        """The first block of a kind as JSON, None where there is none."""
        return next((json.loads(payload) for k, payload in self.blocks if k == kind), None)


def read(path: Path) -> JournalContents:
    """Read a journal file. Raises RecordingError: missing, or as `parse`."""
    try:
        return parse(path, path.read_bytes())
    except OSError as error:
        raise RecordingError(f"journal {path}: {error.strerror}") from None


def parse(path: Path, data: bytes) -> JournalContents:
    """Parse a journal's bytes, complete or partial: only damaged blocks are lost.

    Raises RecordingError: not a journal.
    """
    start = len(MAGIC)
    damaged = sum(a != b for a, b in zip(data[:start], MAGIC, strict=False)) if len(data) > start else 0
    blocks, end, between = whole_blocks(data, start)
    if not blocks and not data.startswith(MAGIC):
        raise RecordingError(f"journal {path}: is not a journal, or its start was overwritten")
    missing, expected = 0, 0
    for _, number, _ in blocks:
        missing += (number - expected) & 0xFFFF
        expected = number + 1
    damaged += between + max(0, len(data) - end)
    return JournalContents(path, [(kind, payload) for kind, _, payload in blocks], damaged, missing)


def whole_blocks(data: bytes, at: int) -> tuple[list[tuple[Kind, int, bytes]], int, int]:
    """The whole blocks from a place on: kind, number and payload of each; the end of the last; bytes between them."""
    blocks, end, damaged = [], at, 0
    while 0 <= at < len(data):
        block = block_at(data, at)
        if block is None:
            at = data.find(MARK, at + 1)
            continue
        *content, after = block
        blocks.append(tuple(content))
        damaged += at - end
        at = end = after
    return blocks, end, damaged


def block_at(data: bytes, at: int) -> tuple[Kind, int, bytes, int] | None:
    """Kind, number and payload of the block at a place, and the place after it; None: there is no whole one."""
    if at + _BLOCK.size > len(data):
        return None
    mark, kind, number, length, crc = _BLOCK.unpack_from(data, at)
    start = at + _BLOCK.size
    if mark != MARK or length > MAX_PAYLOAD or start + length > len(data):
        return None
    payload = data[start : start + length]
    if zlib.crc32(payload, zlib.crc32(data[at : at + _CRC_AT])) != crc:
        return None
    try:
        return Kind(kind), number, payload, start + length
    except ValueError:
        return None

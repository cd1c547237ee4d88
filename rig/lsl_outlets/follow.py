"""Follows journals as they grow. It only reads: it takes no lock, and writes nothing, not even the time of access."""

from __future__ import annotations

import contextlib
import ctypes
import os
from pathlib import Path

from stimrig.rig import journal
from stimrig.rig.errors import RecordingError
from stimrig.rig.journal import MAGIC, Kind

AT_ONCE_BYTES = 1 << 18
FREE_TO_READ = {0xEF53: "ext2 to ext4", 0x9123683E: "btrfs", 0x01021994: "tmpfs", 0x794C7630: "overlay"}
"""File systems, by their magic number (statfs(2)), on which reading a file never makes its writer wait. On XFS and
over NFS a read holds the file's lock: a reader of low priority that is interrupted would hold up the rig."""


def refuse_locking(folder: Path) -> None:
    """Raise RecordingError if the folder lies where a reader could hold up the writer."""
    found = ctypes.create_string_buffer(256)
    if ctypes.CDLL(None, use_errno=True).statfs(os.fsencode(folder), found) != 0:
        raise RecordingError(f"{folder}: {os.strerror(ctypes.get_errno())}; give the rig's data folder with --data")
    magic = ctypes.cast(found, ctypes.POINTER(ctypes.c_long))[0]
    if magic not in FREE_TO_READ:
        raise RecordingError(
            f"{folder}: lies on a file system (number {magic:#x}) on which reading may hold up the rig's writing, so "
            f"nothing is streamed; put the data folder on one of: {', '.join(FREE_TO_READ.values())}"
        )


class Tail:
    """One journal, read from its start on.

    Raises
    ------
    OSError
        It is gone, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_NOATIME)
        except PermissionError:  # only the owner may ask for that
            self._fd = os.open(path, os.O_RDONLY)
        self._read = 0
        self._buffer = b""
        self.damaged_bytes = 0

    def blocks(self) -> list[tuple[Kind, bytes]]:
        """The blocks that came since, at most `AT_ONCE_BYTES` of them; a damaged one is left out."""
        piece = os.pread(self._fd, AT_ONCE_BYTES, self._read)
        if self._read == 0:
            if len(piece) < len(MAGIC):
                return []
            self._read, piece = len(MAGIC), piece[len(MAGIC) :]
        self._read += len(piece)
        if not piece:
            return []
        self._buffer += piece
        found, end, damaged = journal.whole_blocks(self._buffer, 0)  # of what follows some may not have come yet
        self.damaged_bytes += damaged
        self._buffer = self._buffer[end:]
        return [(kind, payload) for kind, _, payload in found]

    def left(self) -> bool:
        """Whether the rig has sealed it, or moved it aside."""
        try:
            here, there = os.fstat(self._fd), self.path.stat()
        except OSError:
            return True
        return (here.st_dev, here.st_ino) != (there.st_dev, there.st_ino)

    def close(self) -> None:
        os.close(self._fd)


class Journals:
    """The folder of journals: which one to follow next.

    One that lay there before and does not grow was left by a crash; the rig deals with it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._sizes = {path: size for path, _, size in self._listed()}
        self.old = set(self._sizes)
        """Those that were there at the start: if one grows, its test was running already."""

    def following(self, besides: Path | None = None) -> Path | None:
        """The oldest journal that is written and was not followed yet, other than that one; None: there is none."""
        listed = self._listed()
        for gone in self._sizes.keys() - {path for path, _, _ in listed}:
            del self._sizes[gone]
            self.old.discard(gone)
        for path, _, size in sorted(listed, key=lambda entry: entry[1]):
            if size != self._sizes.get(path) and path != besides:
                return path
        return None

    def done(self, path: Path) -> None:
        """It was followed to its end."""
        with contextlib.suppress(OSError):
            self._sizes[path] = path.stat().st_size

    def _listed(self) -> list[tuple[Path, float, int]]:
        found = []
        with contextlib.suppress(OSError), os.scandir(self._folder) as entries:
            for entry in entries:
                if entry.name.endswith(".journal"):
                    with contextlib.suppress(OSError):
                        stat = entry.stat()
                        found.append((Path(entry.path), stat.st_mtime, stat.st_size))
        return found

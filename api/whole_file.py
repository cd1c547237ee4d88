"""Files that are whole or not there: written aside, brought to the disk, and then put into their place."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO


@contextlib.contextmanager
def whole_file(path: Path, aside: Path | None = None, mode: int = 0o666) -> Iterator[IO[bytes]]:
    """Write a file; who reads has the one before, or this one, whole.

    Parameters
    ----------
    aside : Path, optional
        Where it is written, on the same disk; default: a hidden name beside it. What is there is written over.
    mode : int
        Of the file, the process's mask aside.
    """
    part = aside or path.with_name(f".{path.name}.new")
    try:
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # not every file system does this
        sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Bring a folder's list of files to the disk. Raises OSError."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hex. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

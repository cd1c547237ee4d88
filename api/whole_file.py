"""Files that are whole or not there: written aside, brought to the disk, and then put into their place."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def whole_path(path: Path) -> Iterator[Path]:
    """A place to write a file at: what is written takes the file's place once all of it is on the disk, or not at all.

    A pipe, a device and the like are written directly. Raises OSError, with this file's name.
    """
    if path.exists() and not path.is_file():  # before links are resolved: /dev/stdout of a pipe leads to no path
        yield path
        return
    target = Path(os.path.realpath(path))
    aside = target.with_name(f".{target.name}.new{target.suffix}")
    try:
        yield aside
        to_disk(aside)
        if target.exists():
            shutil.copymode(target, aside)
        aside.replace(target)
    except OSError as error:
        if error.filename in (None, aside, str(aside)):
            error.filename = str(path)
        raise
    finally:
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # not every file system can sync a directory
        to_disk(target.parent)


def to_disk(path: Path) -> None:
    """Bring a file, or a folder's list of files, to the disk. Raises OSError."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hex. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

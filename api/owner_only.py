"""Files and folders for their owner's eyes only, those that were there before included."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path


def close(path: Path, mode: int) -> None:
    """Take away what `mode` does not allow; what is another user's is left to its owner."""
    with contextlib.suppress(FileNotFoundError, PermissionError):
        now = stat.S_IMODE(path.stat().st_mode)
        if now & ~mode:
            path.chmod(now & mode)


def folder(path: Path) -> Path:
    """A folder: nobody else looks into one that is made here; one that was there stays as its owner made it."""
    path.mkdir(parents=True, exist_ok=True, mode=0o700)
    return path


def file(path: Path) -> None:
    """A file, made empty where it is not there, which its owner alone may read and write."""
    with contextlib.suppress(FileExistsError):
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
    close(path, 0o600)

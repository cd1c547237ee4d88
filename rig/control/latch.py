"""What the rig must remember across a crash: that a test was running, or that it is latched and why."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from pathlib import Path
from typing import IO, Literal

from rig import archive
from rig.errors import BusyError, RecordingError, RigError

Remembered = Literal["running", "latched"]


class Latch:
    """A small file in the data folder, synced to the disk before the event that it describes."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "latch.json"

    def read(self) -> tuple[Remembered | None, str]:
        """The stored state and its reason; an unreadable file counts as a running test."""
        try:
            content = json.loads(self._path.read_text("utf-8"))
            return ("latched" if content["state"] == "latched" else "running"), str(content["reason"])
        except FileNotFoundError:
            return None, ""
        except (OSError, ValueError, KeyError, TypeError):
            return "running", "the latch file could not be read"

    def write(self, state: Remembered, reason: str) -> None:
        """Store a state. Raises RigError if the disk fails: then nothing may start."""
        try:
            archive.write_atomically(self._path, json.dumps({"state": state, "reason": reason}).encode())
        except RecordingError as error:
            raise RigError(f"latch file: {error}") from None

    def clear(self) -> None:
        """Remove the state: a person has re-armed, or a test has ended well."""
        with contextlib.suppress(FileNotFoundError):
            self._path.unlink()


def lock_folder(folder: Path) -> IO[str]:
    """Make sure that only one rig process uses the data folder. Keep the returned file open meanwhile.

    Raises
    ------
    BusyError
        Another rig uses it; the message names its process.
    """
    file = (folder / "rig.lock").open("a+")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.seek(0)
        holder = file.read().strip() or "unknown"
        file.close()
        raise BusyError(f"data_dir {folder}: another rig (process {holder}) uses it; stop that rig first") from None
    file.truncate(0)
    file.write(str(os.getpid()))
    file.flush()
    return file

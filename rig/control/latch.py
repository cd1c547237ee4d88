"""What the rig must remember across a crash: that a test was running, or that it is latched and why."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from stimrig.rig.control.small_file import SmallFile
from stimrig.rig.machine import Machine

Remembered = Literal["running", "latched"]


class Latch:
    """Stored before the event that it describes."""

    def __init__(self, folder: Path, machine: Machine) -> None:
        self._file = SmallFile(folder / "latch.json", "latch file", machine)
        self.clear = self._file.remove
        """Remove the state: a person has re-armed, or a test has ended well. Raises RigError."""

    async def read(self) -> tuple[Remembered | None, str]:
        """The stored state and its reason; an unreadable file counts as a running test."""
        try:
            content = await self._file.read()
            if content is None:
                return None, ""
            return ("latched" if content["state"] == "latched" else "running"), str(content["reason"])
        except (OSError, ValueError, KeyError):
            return "running", "the latch file could not be read"

    async def write(self, state: Remembered, reason: str) -> None:
        """Store a state. Raises RigError if the disk fails: then nothing may start."""
        await self._file.write({"state": state, "reason": reason})

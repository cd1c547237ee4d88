"""What the rig must remember across a crash: that a test was running, or that it is latched and why."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

from rig.errors import RigError
from rig.machine import Machine
from rig.tasks import Turn

Remembered = Literal["running", "latched"]


class Latch:
    """A small file in the data folder, synced to the disk before the event that it describes.

    What is asked for first is written first.
    """

    def __init__(self, folder: Path, machine: Machine) -> None:
        self._path = folder / "latch.json"
        self._disk, self._work, self._turn = machine.disk, machine.tasks.work, Turn(machine.tasks)
        self._stored: bytes | None = None

    async def read(self) -> tuple[Remembered | None, str]:
        """The stored state and its reason; an unreadable file counts as a running test."""
        try:
            content = json.loads(await self._work(self._disk.read, self._path))
            return ("latched" if content["state"] == "latched" else "running"), str(content["reason"])
        except FileNotFoundError:
            return None, ""
        except (OSError, ValueError, KeyError, TypeError):
            return "running", "the latch file could not be read"

    async def write(self, state: Remembered, reason: str) -> None:
        """Store a state. Raises RigError if the disk fails: then nothing may start."""
        data = json.dumps({"state": state, "reason": reason}).encode()
        async with self._turn:
            if data == self._stored:
                return
            self._stored = None
            try:
                await self._work(self._disk.replace, self._path, data)
            except OSError as error:
                raise RigError(f"latch file: {self._path}: {error.strerror}; free some disk space") from None
            self._stored = data

    async def clear(self) -> None:
        """Remove the state: a person has re-armed, or a test has ended well. Raises RigError."""
        async with self._turn:
            self._stored = None
            try:
                await self._work(self._disk.remove, self._path)
            except OSError as error:
                raise RigError(f"latch file: {self._path}: {error.strerror}; free some disk space") from None

"""A small file of JSON in the data folder, synced to the disk before what it describes is told."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from stimrig.rig.errors import RigError
from stimrig.rig.machine import Machine
from stimrig.rig.tasks import Turn


class SmallFile:
    """What is asked for first is written first. `place` begins the words of an error."""

    def __init__(self, path: Path, place: str, machine: Machine) -> None:
        self.path, self._place = path, place
        self._disk, self._work, self._turn = machine.disk, machine.tasks.work, Turn(machine.tasks)
        self._stored: bytes | None = None

    async def read(self) -> dict[str, Any] | None:
        """Its content; None: there is no file. Raises OSError, ValueError: it cannot be read."""
        try:
            content = json.loads(await self._work(self._disk.read, self.path))
        except FileNotFoundError:
            return None
        except RecursionError as error:
            raise ValueError(str(error)) from None
        if not isinstance(content, dict):
            raise ValueError("it is no JSON object")
        return content

    async def write(self, content: dict[str, Any]) -> None:
        """Replace the file, unless it holds that already. Raises RigError."""
        await self._put(json.dumps(content).encode())

    async def remove(self) -> None:
        """Also where there is none. Raises RigError."""
        await self._put(None)

    async def _put(self, data: bytes | None) -> None:
        async with self._turn:
            if data is not None and data == self._stored:
                return
            self._stored = None
            try:
                if data is None:
                    await self._work(self._disk.remove, self.path)
                else:
                    await self._work(self._disk.replace, self.path, data)
            except OSError as error:
                raise RigError(f"{self._place}: {self.path}: {error.strerror}; free some disk space") from None
            self._stored = data

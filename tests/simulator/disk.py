"""A disk in memory: slow, full, failing, and with a memory of what was synced."""

from __future__ import annotations

import contextlib
import errno
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stimrig.rig.errors import BusyError
from tests.simulator.world import World

ROOM_BYTES = 10**9


def error_of(number: int, path: Path) -> OSError:
    """As the system gives it."""
    return OSError(number, os.strerror(number), str(path))


class _File:
    def __init__(self, data: bytes = b"", synced: int = 0) -> None:
        self.data, self.synced = bytearray(data), synced


class SimulatedDisk:
    """See `stimrig.rig.machine.Disk`. Files outlive the processes; a power failure takes what was not synced."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.files: dict[Path, _File] = {}
        self.free = ROOM_BYTES
        self.failing = False
        self.slow_s = 0.0
        """How long each piece of work takes at least."""
        self.well_since_s = -math.inf
        """When it had room again, gave no errors and was quick."""
        self.access: Callable[[], None] = lambda: None
        """Called at each append: there a step may be stalled."""
        self.replaced: list[tuple[float, str, bool]] = []
        """Each file that was to be replaced: when, its name, and whether the disk took it."""
        self.removed: list[tuple[float, str]] = []
        self._locked = False
        self.written: set[Path] = set()
        """Logs that are open."""

    @property
    def is_well(self) -> bool:
        """Whether it works as it should."""
        return not self.failing and not self.slow_s and self.free > ROOM_BYTES / 2

    def heal(self) -> None:
        """Room, no errors, quick."""
        self.free, self.failing, self.slow_s = ROOM_BYTES, False, 0.0
        self.well_since_s = self.world.now_s

    def work_s(self) -> float:
        """How long a piece of work in another thread takes."""
        return self.slow_s + self.world.chance.uniform(0.0002, 0.015)

    def make_folder(self, path: Path) -> None:
        self._may_write(path)

    def lock(self, folder: Path) -> contextlib.AbstractContextManager[Any]:
        if self._locked:
            raise BusyError(f"data_dir {folder}: another rig uses it; stop that rig first")
        self._locked = True
        return contextlib.ExitStack()

    def process_ended(self) -> None:
        """Its locks are gone."""
        self._locked = False
        self.written.clear()

    def create(self, path: Path) -> SimulatedLog:
        self._may_write(path)
        if path in self.files:
            raise error_of(errno.EEXIST, path)
        self.files[path] = _File()
        self.written.add(path)
        return SimulatedLog(self, path)

    def is_written(self, path: Path) -> bool:
        return path in self.written

    def read(self, path: Path) -> bytes:
        if path not in self.files:
            raise error_of(errno.ENOENT, path)
        return bytes(self.files[path].data)

    def replace(self, path: Path, data: bytes) -> None:
        takes = not self.failing and self.free >= len(data)
        self.replaced.append((self.world.now_s, path.name, takes))
        self._may_write(path, len(data))
        self.files[path] = _File(data, len(data))

    def rename(self, path: Path, to: Path) -> None:
        self._may_write(path)
        self.files[to] = self.files.pop(path)

    def remove(self, path: Path) -> None:
        self._may_write(path)
        self.files.pop(path, None)
        self.removed.append((self.world.now_s, path.name))

    def names(self, folder: Path) -> list[str]:
        return sorted(path.name for path in self.files if path.parent == folder)

    def free_bytes(self, folder: Path) -> int:
        self._may_write(folder)
        return self.free

    def power_failure(self) -> None:
        """What was not synced is lost, up to a random place, at which it is torn."""
        for file in self.files.values():
            kept = self.world.chance.randint(file.synced, len(file.data))
            del file.data[kept:]

    def append(self, path: Path, data: bytes) -> None:
        """Through to the kernel; a full disk takes a part."""
        self.access()
        self._may_write(path)
        taken = data if self.free >= len(data) else data[: max(0, self.free)]
        self.files[path].data += taken
        self.free -= len(taken)
        if len(taken) < len(data):
            raise error_of(errno.ENOSPC, path)

    def sync(self, path: Path) -> None:
        """As fdatasync."""
        self._may_write(path)
        if path in self.files:
            self.files[path].synced = len(self.files[path].data)

    def _may_write(self, path: Path, size: int = 0) -> None:
        if self.failing:
            raise error_of(errno.EIO, path)
        if self.free < size:
            raise error_of(errno.ENOSPC, path)


class SimulatedLog:
    """See `stimrig.rig.machine.Log`."""

    def __init__(self, disk: SimulatedDisk, path: Path) -> None:
        self.path, self._disk = path, disk

    def append(self, data: bytes) -> None:
        self._disk.append(self.path, data)

    def sync(self) -> None:
        self._disk.sync(self.path)

    def close(self) -> None:
        self._disk.written.discard(self.path)
        self.sync()

"""The machine on which the rig runs, as small Protocols: every call that blocks goes through them.

`stimrig.rig.adapters` has the real ones. A simulator gives others, on a virtual clock. No adapter decides anything.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

from stimrig.rig.tasks import Tasks

OnMessage = Callable[[str], None]
"""Called with a reason, in the tasks' own thread."""
B = TypeVar("B")


class Port(Protocol):
    """A serial port. What it calls, it calls in the tasks' own thread."""

    def open(self, on_bytes: Callable[[bytes, float], None], on_lost: OnMessage) -> None:
        """Open it and begin to read; blocks for a moment.

        `on_bytes`: called with what was read, and when (rig clock, s); `on_lost`: called once if the port is gone.
        Raises DeviceError: it cannot be opened; names the port and says how to correct it.
        """
        ...

    def write(self, data: bytes) -> int:
        """Give bytes to the operating system without waiting; how many it took. Raises OSError."""
        ...

    def discard(self) -> None:
        """Forget bytes that were written but still wait in this computer; never raises."""
        ...

    def close(self) -> None:
        """Never raises."""
        ...


class Frame(NamedTuple):
    """A CAN frame, when the host read it (rig clock, s) and the interface's own stamp of it (s; NaN: none)."""

    frame_id: int
    data: bytes
    host_time_s: float
    stamp_s: float


class Listener(NamedTuple):
    """Receiver of the frames of one identifier."""

    frame_id: int
    is_extended: bool  # whether the identifier has 29 bits: the one of 11 bits that has the same number is another one
    decode: Callable[[Sequence[Frame], int, int], Any]
    """Pure; makes a block of frames. Its arguments: the frames, and how many damaged and error frames came with
    them."""
    handle: Callable[[Any], None]  # gets each block, in the tasks' own thread
    lost: OnMessage  # called once with the reason when the bus is gone


class Bus(Protocol):
    """A CAN adapter that is open."""

    place: str
    """Its name in messages."""

    def listen(self, listener: Listener) -> None:
        """Hand frames to it from now on."""
        ...

    def detach(self, listener: Listener) -> None:
        """Hand no more frames to it."""
        ...

    def send(self, frames: Sequence[tuple[int, bytes, bool]]) -> None:
        """Send frames (identifier, data, whether the identifier is extended); blocks. Raises DeviceError."""
        ...

    def close(self) -> None:
        """Close it for all who listen; never raises."""
        ...


class Log(Protocol):
    """A file that is only appended to."""

    path: Path

    def append(self, data: bytes) -> None:
        """Write through to the kernel: it survives this process. Raises OSError; part of it may have been written."""
        ...

    def sync(self) -> None:
        """Sync to the disk, so that written data survives a power failure; blocks. Raises OSError."""
        ...

    def close(self) -> None:
        """Sync and close."""
        ...


class Disk(Protocol):
    """The rig's files. All of it but `Log.append` may block for long: call it by `Tasks.work`."""

    def make_folder(self, path: Path) -> None:
        """With its parents, if it is missing. Raises OSError."""
        ...

    def lock(self, folder: Path) -> AbstractContextManager[Any]:
        """Make sure that one rig only uses the folder, until what is returned is closed. Raises BusyError, OSError."""
        ...

    def create(self, path: Path) -> Log:
        """A new, locked file whose name survives a power failure. Raises OSError, also if it exists."""
        ...

    def is_written(self, path: Path) -> bool:
        """Return whether a process, of this rig or another, has it open as `create` gave it."""
        ...

    def read(self, path: Path) -> bytes:
        """Raises OSError."""
        ...

    def replace(self, path: Path, data: bytes) -> None:
        """Write the whole file: afterwards, and after any crash, it is the old one or the new one. Raises OSError."""
        ...

    def rename(self, path: Path, to: Path) -> None:
        """Raises OSError."""
        ...

    def remove(self, path: Path) -> None:
        """Also where there is none. Raises OSError."""
        ...

    def names(self, folder: Path) -> list[str]:
        """Names in a folder, sorted; none where there is no folder."""
        ...

    def free_bytes(self, folder: Path) -> int:
        """Room that is left. Raises OSError."""
        ...


class Machine(Protocol):
    """All of it."""

    tasks: Tasks
    disk: Disk
    boot_id: str
    """Identifier of this boot of the machine; empty if the system has none."""

    def port(self, path: str, **arguments: Any) -> Port:
        """The stimulator's serial port, not yet opened; arguments of `serial.Serial`."""
        ...

    def open_bus(self, arguments: dict[str, Any], name: str) -> Bus:
        """Open a CAN adapter; blocks. Raises DeviceError; `name` is the device's, for messages."""
        ...

    def shared_bus(self, arguments: dict[str, Any], name: str) -> Bus | None:
        """An adapter that is open already. Raises DeviceError if it is open with other arguments."""
        ...

    head_start_s: float
    """Real seconds before a pulse is due at which its sender wakes, so that all is looked at by then."""

    def hold_until(self, time_s: float) -> None:
        """Let nothing else of this process's tasks run until then (rig clock), `head_start_s` at most."""
        ...

    def blocked_by(self, stood_s: float) -> str:
        """Why this process has just stood still for so many real seconds, in words; empty: the system does not know."""
        ...

    def undisturbed(self) -> AbstractContextManager[None]:
        """While entered, the tasks run before everything else on this machine, as far as it allows that."""
        ...

    def new_id(self) -> str:
        """A new one of 32 hexadecimal digits."""
        ...

    def cpu_s(self) -> float:
        """Seconds of processor time that this process has used."""
        ...

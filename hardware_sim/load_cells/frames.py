"""What passes between sampler, cell and transport, and what the two kinds answer to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

LARGEST_STANDARD_ID = 0x7FF


class Sample(NamedTuple):
    """One reading of the cell; `time_us` is on the cell's own clock; `counter` never wraps, a cell's layout does."""

    torque_nm: float
    counter: int
    sync: bool
    time_us: int


class Frame(NamedTuple):
    """One CAN frame; `error` marks a bus error that the adapter reports."""

    can_id: int
    data: bytes
    time_us: int
    error: bool = False


FrameHandler = Callable[[int, bytes], None]
"""Takes a frame that the host sent: id and data."""


class CellProtocol(Protocol):
    """A load cell's electronics: how samples become frames, and what starts and stops them.

    Its constructor takes the samples a frame, one of `layouts`. A frame's time is that of its last sample.
    """

    layouts: tuple[int, ...]
    samples_per_frame: int
    has_counter: bool
    has_sync: bool

    def running(self) -> bool:
        """Whether it is sending."""
        ...

    def encode(self, samples: Sequence[Sample]) -> Frame:
        """The frame of `samples_per_frame` samples."""
        ...

    def received(self, can_id: int, data: bytes) -> None:
        """A frame from the host."""
        ...


class TransportProtocol(Protocol):
    """What stands between the CAN bus and the host; its constructor takes the reactor and a `FrameHandler`."""

    can: dict[str, Any]
    """For `can.Bus(**can)` as it is."""
    overruns: int
    """Frames dropped because the host did not read."""

    def send(self, frames: Sequence[Frame]) -> None:
        """Frames to every client that listens; never blocks."""
        ...

    def close(self) -> None:
        """Unplug."""
        ...

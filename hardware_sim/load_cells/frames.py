"""Samples and frames, and the protocols of cells and transports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

LARGEST_STANDARD_ID = 0x7FF


class AngleReading(NamedTuple):
    """What a sensor of the joint's angle says: degrees from its own zero in its own direction, and its fault bit."""

    angle_deg: float
    fault: bool


class Sample(NamedTuple):
    """One reading, taken at the emulated `time_s`, which is `time_us` on the cell's own clock.

    `counter` never wraps here, only in a cell's frames.

    `angle` is there where the cell's electronics read a joint angle too.
    """

    torque_nm: float
    counter: int
    sync: bool
    time_us: int
    angle: AngleReading | None = None
    time_s: float = 0.0


class Frame(NamedTuple):
    """One CAN frame; `error` marks a bus error that the adapter reports.

    `time_us` is the sensor's own stamp. `time_s` is the emulated time at which it leaves the sensor: that of its last
    sample, or later where a fault delays it.
    """

    can_id: int
    data: bytes
    time_us: int
    error: bool = False
    time_s: float = 0.0


FrameHandler = Callable[[int, bytes], None]
"""Called with the id and data of each frame from the host."""


class CellProtocol(Protocol):
    """A load cell's electronics: how samples become frames, and what starts and stops them.

    Its constructor takes the number of samples per frame, one of `layouts`. A frame's time is that of its last sample.
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


class AlwaysOn:
    """Base of cells that send from power-on and take no commands."""

    def __init__(self, samples_per_frame: int = 1) -> None:
        self.samples_per_frame = samples_per_frame

    def running(self) -> bool:
        """From power-on."""
        return True

    def received(self, can_id: int, data: bytes) -> None:
        """Takes no commands."""


class TransportProtocol(Protocol):
    """What connects the CAN bus to the host; its constructor takes the reactor and a `FrameHandler`."""

    can: dict[str, Any]
    """Arguments of `can.Bus`."""
    overruns: int
    """Frames dropped because the host did not read."""

    def send(self, frames: Sequence[Frame]) -> None:
        """Frames to every client that listens; never blocks."""
        ...

    def close(self) -> None:
        """Unplug."""
        ...

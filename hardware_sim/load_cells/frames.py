"""Samples and frames, and what carries frames to the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

LARGEST_STANDARD_ID = 0x7FF


class AngleReading(NamedTuple):
    """Reading of a sensor of the joint's angle: degrees from its own zero in its own direction, and its fault bit."""

    angle_deg: float
    fault: bool


class Sample(NamedTuple):
    """One reading, taken at the emulated `time_s`, which is `time_us` on the cell's own clock.

    `counter` never wraps here, only in a cell's frames. `angle` is there where the cell's electronics read a joint's
    angle too.
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

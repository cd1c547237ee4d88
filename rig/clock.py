"""Clocks are passed in: monotonic time for decisions, UTC as a label only.

The rig runs on `MonotonicClock`. Its `speed` is 1 on hardware. With an emulator that runs n times faster than real
time, the same rig runs with `speed=n`. Nothing here waits: that is the business of `stimrig.rig.tasks`.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Protocol


class Clock(Protocol):
    """Clock of the rig."""

    @property
    def speed(self) -> float:
        """Rig seconds per real second. Time allowances for the operating system are multiplied by it."""
        ...

    def now_s(self) -> float:
        """Monotonic rig time, s."""
        ...

    def unix_s(self) -> float:
        """UTC, s since 1970: a label; only the day until which a calibration holds is told by it."""
        ...


class MonotonicClock:
    """The machine's monotonic clock, `speed` times as fast. It goes on while the machine is suspended.

    So a test that was asleep is late, and ends, instead of going on where it was.
    """

    def __init__(self, speed: float = 1.0) -> None:
        if not (0 < speed < 1000):
            raise ValueError(f"clock speed {speed}: must be above 0 and below 1000")
        self.speed = speed

    def now_s(self) -> float:
        return time.clock_gettime(time.CLOCK_BOOTTIME) * self.speed

    def unix_s(self) -> float:
        return time.time()


def utc_text(unix_s: float) -> str:
    """ISO 8601 with milliseconds, in UTC."""
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

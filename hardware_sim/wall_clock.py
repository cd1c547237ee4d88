"""The machine's clock, for devices that run in real time."""

from __future__ import annotations

import time


class WallClock:
    """Seconds since the start on the monotonic clock, `speed` times faster."""

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed
        self._start_s = time.monotonic()

    def now_s(self) -> float:
        """Emulated seconds since the start."""
        return (time.monotonic() - self._start_s) * self.speed

    def monotonic_s(self, time_s: float) -> float:
        """The machine's monotonic time at an emulated time."""
        return self._start_s + time_s / self.speed

"""Clocks are passed in: monotonic time for decisions, UTC as a label only.

The rig runs on `MonotonicClock`. Its `speed` is 1 on hardware. With an emulator that runs n times faster than real
time, the same rig runs with `speed=n`. `VirtualClock` jumps from event to event, for tests.
"""

from __future__ import annotations

import heapq
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from itertools import count
from typing import Protocol


class Clock(Protocol):
    """What the rig asks of a clock."""

    @property
    def speed(self) -> float:
        """Rig seconds per real second. Time allowances for the operating system are multiplied by it."""
        ...

    def now_s(self) -> float:
        """Monotonic rig time, s."""
        ...

    def wait(self, until_s: float, interrupt: threading.Event | None = None) -> bool:
        """Sleep until `until_s`; return True at once if `interrupt` is or becomes set."""
        ...

    def unix_s(self) -> float:
        """UTC, s since 1970: a label, never used for a decision."""
        ...


class MonotonicClock:
    """The machine's monotonic clock, `speed` times as fast."""

    def __init__(self, speed: float = 1.0) -> None:
        if not (0 < speed < 1000):
            raise ValueError(f"clock speed {speed}: must be above 0 and below 1000")
        self.speed = speed

    def now_s(self) -> float:
        return time.monotonic() * self.speed

    def wait(self, until_s: float, interrupt: threading.Event | None = None) -> bool:
        remaining_s = (until_s - self.now_s()) / self.speed
        if interrupt is not None:
            return interrupt.wait(max(0.0, remaining_s))
        if remaining_s > 0:
            time.sleep(remaining_s)
        return False

    def unix_s(self) -> float:
        return time.time()


class VirtualClock:
    """A clock that moves only when somebody waits; `call_at` schedules what the fakes do meanwhile.

    For one thread: waiting runs the scheduled events up to the deadline in order, then returns.
    """

    def __init__(self, start_s: float = 1000.0, unix_start_s: float = 1_700_000_000.0) -> None:
        self.speed = 1.0
        self._now_s = start_s
        self._unix_offset_s = unix_start_s - start_s
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()

    def now_s(self) -> float:
        return self._now_s

    def unix_s(self) -> float:
        return self._now_s + self._unix_offset_s

    def call_at(self, time_s: float, action: Callable[[], None]) -> None:
        """Run `action` when the clock passes `time_s`."""
        heapq.heappush(self._events, (time_s, next(self._order), action))

    def advance(self, duration_s: float) -> None:
        """Jump without running events: the process was not scheduled."""
        self._now_s += duration_s

    def wait(self, until_s: float, interrupt: threading.Event | None = None) -> bool:
        while not (interrupt is not None and interrupt.is_set()):
            if not self._events or self._events[0][0] > until_s:
                self._now_s = max(self._now_s, until_s)
                return False
            time_s, _, action = heapq.heappop(self._events)
            self._now_s = max(self._now_s, time_s)
            action()
        return True


def utc_text(unix_s: float) -> str:
    """ISO 8601 with milliseconds, in UTC."""
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

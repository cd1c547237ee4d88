"""The emulated time: events on a clock that the caller advances.

The emulator advances it with the machine's monotonic clock; simulations advance it by hand and finish fast.
"""

from __future__ import annotations

import heapq
import itertools
import time
from collections.abc import Callable


class Event:
    """An action planned for `time_s`."""

    __slots__ = ("action", "time_s")

    def __init__(self, time_s: float, action: Callable[[], None]) -> None:
        self.time_s = time_s
        self.action: Callable[[], None] | None = action


def cancel(*events: Event | None) -> None:
    """Do nothing of these when their time comes."""
    for event in events:
        if event is not None:
            event.action = None


class Timeline:
    """Events in the order of their time, in seconds of the emulator's own clock.

    `follow` is called with the new time before time advances to it, so that continuous processes (the sampled muscle)
    are simulated up to an event before the event changes them.
    """

    def __init__(self) -> None:
        self.now_s = 0.0
        self.follow: Callable[[float], None] = lambda _time_s: None
        self._events: list[tuple[float, int, Event]] = []
        self._order = itertools.count()

    def at(self, time_s: float, action: Callable[[], None]) -> Event:
        """Do `action` when time reaches `time_s`, or at the next advance if that has passed."""
        event = Event(max(time_s, self.now_s), action)
        heapq.heappush(self._events, (event.time_s, next(self._order), event))
        return event

    def after(self, delay_s: float, action: Callable[[], None]) -> Event:
        """Do `action` in `delay_s` seconds."""
        return self.at(self.now_s + delay_s, action)

    def next_s(self) -> float | None:
        """Time of the next event, or None."""
        while self._events and self._events[0][2].action is None:
            heapq.heappop(self._events)
        return self._events[0][0] if self._events else None

    def run_until(self, time_s: float) -> None:
        """Advance time to `time_s`, with all events up to it, also those that `follow` plans on the way."""
        while True:
            while (event_s := self.next_s()) is not None and event_s <= time_s:
                self._move(event_s)
                event = heapq.heappop(self._events)[2]
                if event.action is not None:
                    event.action()
            self._move(time_s)
            if not self._events or self._events[0][0] > time_s:
                return

    def _move(self, time_s: float) -> None:
        if time_s > self.now_s:
            self.follow(time_s)
            self.now_s = time_s


class WallClock:
    """Seconds since the start on the machine's monotonic clock, `speed` times faster."""

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed
        self._start_s = time.monotonic()

    def now_s(self) -> float:
        """Emulated seconds since the start."""
        return (time.monotonic() - self._start_s) * self.speed

    def monotonic_s(self, time_s: float) -> float:
        """The machine's monotonic time at an emulated time."""
        return self._start_s + time_s / self.speed

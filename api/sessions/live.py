"""The live channel: what the rig shows while a test runs, passed to every open page."""

from __future__ import annotations

import asyncio
from typing import Any

from api.clock import Clock
from rig.messages import LiveEvent

QUEUE_LENGTH = 200
SERIES = ("time_s", "torque_min_nm", "torque_max_nm", "pulse_time_s", "pulse_width_us")


def within_test(event: LiveEvent) -> LiveEvent:
    """A frame without bins from before the test's own clock had begun: they would be drawn across the chart."""
    kept = [index for index, time_s in enumerate(event.time_s) if -1.0 <= time_s <= event.elapsed_s + 1.0]
    if len(kept) == len(event.time_s):
        return event
    series = {name: [getattr(event, name)[index] for index in kept] for name in SERIES[:3]}
    return event.model_copy(update=series)


class Hub:
    """Keeps the current test's drawn history, so that a page opened late sees all of it, and the newest torque."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self._torque: tuple[float, float] | None = None
        self.test_id: str | None = None
        self.history: dict[str, list[float]] = {name: [] for name in SERIES}
        self.newest: LiveEvent | None = None
        self._queues: set[asyncio.Queue[dict[str, Any]]] = set()

    def begin(self, test_id: str) -> None:
        """A new test: forget the last one's curves."""
        self.test_id, self.newest = test_id, None
        self.history = {name: [] for name in SERIES}

    def live(self, event: LiveEvent) -> None:
        """Take a frame, keep it, pass it on."""
        if event.torque_max_nm:
            middle_nm = (event.torque_min_nm[-1] + event.torque_max_nm[-1]) / 2
            self._torque = middle_nm, self.clock.monotonic_s() - event.torque_age_s
        if event.test_id == self.test_id and event.test_id is not None:
            event = within_test(event)
            self.newest = event
            for name in SERIES:
                self.history[name].extend(getattr(event, name))
        self.send({"type": "live", **event.model_dump(exclude={"event"})})

    def torque(self) -> tuple[float | None, float | None]:
        """The newest torque, N·m, and its age, s; None for both where none ever came."""
        if self._torque is None:
            return None, None
        torque_nm, measured_s = self._torque
        return torque_nm, self.clock.monotonic_s() - measured_s

    def position(self, test_id: str) -> tuple[float, float, str | None] | None:
        """Elapsed and total seconds, and the segment, of the running test."""
        if self.test_id != test_id or self.newest is None:
            return None
        return self.newest.elapsed_s, self.newest.duration_s, self.newest.segment

    def send(self, message: dict[str, Any]) -> None:
        """Pass a message to every page; a page that does not keep up loses its oldest frames."""
        for queue in self._queues:
            if queue.full():
                queue.get_nowait()
            queue.put_nowait(message)

    def open(self) -> asyncio.Queue[dict[str, Any]]:
        """A page's queue, with the history so far as its first message."""
        queue: asyncio.Queue[dict[str, Any]] = asyncio.Queue(QUEUE_LENGTH)
        position = self.position(self.test_id) if self.test_id else None
        duration_s = position[1] if position else 0.0
        history = {name: list(values) for name, values in self.history.items()}
        queue.put_nowait({"type": "history", "test_id": self.test_id, "duration_s": duration_s, **history})
        self._queues.add(queue)
        return queue

    def close(self, queue: asyncio.Queue[dict[str, Any]]) -> None:
        """A page has gone."""
        self._queues.discard(queue)

    @property
    def listeners(self) -> int:
        """How many pages listen."""
        return len(self._queues)

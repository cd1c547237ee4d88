"""The live channel: what the rig shows while a test runs, passed to every open page."""

from __future__ import annotations

import asyncio
from typing import Any

from stimrig.api.clock import Clock
from stimrig.rig.messages import LiveEvent

QUEUE_LENGTH = 200
SERIES = ("time_s", "torque_min_nm", "torque_max_nm", "pulse_time_s", "pulse_width_us")
ANGLES = ("angle_time_s", "angle_rad", "velocity_rad_s")
"""Of a rig with an angle sensor: one of each for each frame."""

ANGLE_OLD_S = 0.5
"""An older angle is not shown as that of now."""


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
        self._angle: tuple[float, float] | None = None
        self.test_id: str | None = None
        self.history: dict[str, list[float]] = {name: [] for name in (*SERIES, *ANGLES)}
        self.newest: LiveEvent | None = None
        self._queues: set[asyncio.Queue[dict[str, Any]]] = set()

    def begin(self, test_id: str) -> None:
        """A new test: forget the last one's curves."""
        self.test_id, self.newest = test_id, None
        self.history = {name: [] for name in (*SERIES, *ANGLES)}

    def live(self, event: LiveEvent) -> None:
        """Take a frame, keep it, pass it on."""
        if event.torque_max_nm:
            middle_nm = (event.torque_min_nm[-1] + event.torque_max_nm[-1]) / 2
            self._torque = middle_nm, self.clock.monotonic_s() - event.torque_age_s
        if event.angle_rad is not None:
            self._angle = event.angle_rad, self.clock.monotonic_s()
        if event.test_id == self.test_id and event.test_id is not None:
            event = within_test(event)
            self.newest = event
            for name in SERIES:
                self.history[name].extend(getattr(event, name))
            self._keep_angle(event)
        self.send({"type": "live", **event.model_dump(exclude={"event"})})

    def _keep_angle(self, event: LiveEvent) -> None:
        if event.angle_rad is not None and event.velocity_rad_s is not None:
            values = event.elapsed_s, event.angle_rad, event.velocity_rad_s
            for name, value in zip(ANGLES, values, strict=True):
                self.history[name].append(value)

    def torque(self) -> tuple[float | None, float | None]:
        """The newest torque, N·m, and its age, s; None for both where none ever came."""
        if self._torque is None:
            return None, None
        torque_nm, measured_s = self._torque
        return torque_nm, self.clock.monotonic_s() - measured_s

    def angle(self) -> float | None:
        """The joint's angle of now, rad; None where none came lately."""
        if self._angle is None or not (self.clock.monotonic_s() - self._angle[1] <= ANGLE_OLD_S):
            return None
        return self._angle[0]

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

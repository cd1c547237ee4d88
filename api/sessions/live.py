"""The live channel: what the rig shows while a test runs, passed to every open page."""

from __future__ import annotations

import asyncio
from math import floor, isfinite
from typing import Any

from pydantic import Field

from stimrig.api.clock import Clock
from stimrig.rig.messages import LiveEvent, LiveState

QUEUE_LENGTH = 200
BIN_S = 0.01
ANGLE_OLD_S = 0.5
"""An older angle is not shown as that of now."""
SERIES = ("time_s", "torque_min_nm", "torque_max_nm", "pulse_time_s", "pulse_width_us")
ANGLES = ("angle_time_s", "angle_rad", "velocity_rad_s")
"""Series of a rig with an angle sensor: one value of each for each frame."""


class LiveOut(LiveState):
    """A message of the live channel of the type `live`; `type` stands in the place of `event`. Times from the begin of
    the test, s: negative ones, at most 1 s, are before it."""

    time_s: list[float] = Field(description="start of each bin on the test's clock, s")
    torque_min_nm: list[float]
    torque_max_nm: list[float]
    pulse_time_s: list[float]
    pulse_width_us: list[float]


def frame_of(event: LiveEvent) -> LiveOut:
    """Return what pages draw of an event: the torque as minimum and maximum of bins of 10 ms, and the pulses.

    Bins from before the test's own clock had begun are left out: they would be drawn across the chart.
    """
    bins: dict[int, tuple[float, float]] = {}
    for host_s, _, torque_nm, _, _ in event.torque_rows():
        number, value = floor((host_s - event.zero_s) / BIN_S), torque_nm if isfinite(torque_nm) else 0.0
        low, high = bins.get(number, (value, value))
        bins[number] = min(low, value), max(high, value)
    if event.test_id is not None:
        bins = {number: both for number, both in bins.items() if -1.0 <= number * BIN_S <= event.elapsed_s + 1.0}
    return LiveOut(
        **{name: getattr(event, name) for name in LiveState.model_fields},
        time_s=[round(number * BIN_S, 4) for number in bins],
        torque_min_nm=[round(low, 5) for low, _ in bins.values()],
        torque_max_nm=[round(high, 5) for _, high in bins.values()],
        pulse_time_s=[index / event.pulse_rate_hz for index in event.outcomes.index],
        pulse_width_us=event.outcomes.pulse_width_us,
    )


class Hub:
    """Passes messages to open pages; keeps the newest torque and angle, and the current test's curves for late pages.

    `newest`: the newest frame of the current test.
    """

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self._torque: tuple[float, float] | None = None
        self._angle: tuple[float, float] | None = None
        self._queues: set[asyncio.Queue[dict[str, Any]]] = set()
        self.begin(None)

    def begin(self, test_id: str | None) -> None:
        """Begin a new test: the last one's curves are forgotten."""
        self.test_id = test_id
        self.newest: LiveOut | None = None
        self.history: dict[str, list[float]] = {name: [] for name in (*SERIES, *ANGLES)}

    def live(self, event: LiveEvent) -> None:
        """Keep an event of the rig and pass it on."""
        frame, now_s = frame_of(event), self.clock.monotonic_s()
        if frame.torque_max_nm:
            self._torque = (frame.torque_min_nm[-1] + frame.torque_max_nm[-1]) / 2, now_s - event.torque_age_s
        if event.angle_rad is not None:
            self._angle = event.angle_rad, now_s
        if event.test_id == self.test_id and event.test_id is not None:
            self.newest = frame
            for name in SERIES:
                self.history[name].extend(getattr(frame, name))
            if frame.angle_rad is not None and frame.velocity_rad_s is not None:
                for name, value in zip(ANGLES, (frame.elapsed_s, frame.angle_rad, frame.velocity_rad_s), strict=True):
                    self.history[name].append(value)
        self.send({"type": "live", **frame.model_dump(exclude={"event"})})

    def torque(self) -> tuple[float | None, float | None]:
        """Return the newest torque, N·m, and its age, s; None for both where none ever came."""
        return (None, None) if self._torque is None else (self._torque[0], self.clock.monotonic_s() - self._torque[1])

    def angle(self) -> float | None:
        """Return the joint's angle now, rad; None where none came lately."""
        if self._angle is None or not (self.clock.monotonic_s() - self._angle[1] <= ANGLE_OLD_S):
            return None
        return self._angle[0]

    def position(self, test_id: str | None) -> tuple[float, float, str | None] | None:
        """Return elapsed and total seconds, and the segment, of the running test."""
        if self.newest is None or self.test_id != test_id:
            return None
        return self.newest.elapsed_s, self.newest.duration_s, self.newest.segment

    def send(self, message: dict[str, Any]) -> None:
        """Pass a message to every page; a page that does not keep up loses its oldest frames."""
        for queue in self._queues:
            if queue.full():
                queue.get_nowait()
            queue.put_nowait(message)

    def open(self) -> asyncio.Queue[dict[str, Any]]:
        """Return the queue of a page, with the history so far as its first message."""
        queue: asyncio.Queue[dict[str, Any]] = asyncio.Queue(QUEUE_LENGTH)
        duration_s = self.newest.duration_s if self.newest else 0.0
        history = {name: list(values) for name, values in self.history.items()}
        queue.put_nowait({"type": "history", "test_id": self.test_id, "duration_s": duration_s, **history})
        self._queues.add(queue)
        return queue

    def close(self, queue: asyncio.Queue[dict[str, Any]]) -> None:
        """Forget a page that has gone."""
        self._queues.discard(queue)

    @property
    def listeners(self) -> int:
        """Return the number of connected pages."""
        return len(self._queues)

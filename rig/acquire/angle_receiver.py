"""The angle receiver: a stream that is always open, and records while a test runs.

A sensor that is gone harms no test that does not ask for the angle. So it is opened again by itself, and whether a test
must stop is decided by what the test asks (`stimrig.rig.acquire.angle_guard`).
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.acquire.stream import Stream
from stimrig.rig.align import RATE_TOLERANCE
from stimrig.rig.align_angle import LiveSlope
from stimrig.rig.devices import AngleSensor
from stimrig.rig.errors import DeviceError
from stimrig.rig.journal import Kind
from stimrig.rig.signals import ANGLE_SAMPLE, AngleScale
from stimrig.rig.tasks import Tasks

NAME = "angle sensor"
REOPEN_S = 0.5
"""Real seconds between two attempts to open a sensor that is gone."""
RESTARTED = 10
"""Samples in a row whose numbers are behind: the sensor was without power for a moment and counts from zero."""
LIVE_BLOCKS = 4000
RECENT_S = 1.0
"""Real seconds of angles that are kept for a pose, and for where the joint is."""


class AngleReceiver(Stream):
    """The angle sensor's, which opens it, too."""

    def __init__(self, sensor: AngleSensor, tasks: Tasks) -> None:
        super().__init__(NAME, sensor, tasks, self._gone)
        self.sensor = sensor
        self.scale = sensor.scale
        self.identity: dict[str, Any] = {}
        self.problem = ""
        """Why it gives nothing; empty: it does, or has not been opened yet."""
        self.live: deque[NDArray[Any]] = deque(maxlen=LIVE_BLOCKS)
        """Columns: time of arrival (rig clock, s), angle (rad), velocity (rad/s)."""
        self.angle_rad: float | None = None
        self.velocity_rad_s: float | None = None
        self._delay_s = 0.0
        """Delay of the newest sample against the promptest one since the counter began, rig seconds."""
        self._promptest: tuple[float, float] | None = None
        """Time of the newest sample and the smallest delay until then. It grows by `RATE_TOLERANCE` with time, since a
        sensor may be slower than its nominal rate."""
        self._behind = 0
        self._restarted = False
        """True where the next sample is the first one since it was opened."""
        self._slope = LiveSlope(sensor.sample_rate_hz)
        self._recent: deque[NDArray[Any]] = deque()

    def rescale(self, scale: AngleScale) -> None:
        """From now on the joint's angle by this calibration."""
        self.scale = scale
        self._slope.forget()
        self._recent = deque(self._scaled(samples) for samples in self._recent)

    def data_age_s(self, now_s: float) -> float:
        """Return the age of the newest angle: the time since its arrival, and its delay.

        The delay is against all samples, not those of the last seconds as in `behind_s`: a sensor that falls behind and
        stays there does not become current again.
        """
        return self.age_s(now_s) + self._delay_s

    def recent(self, duration_s: float) -> NDArray[Any]:
        """The samples of the last seconds, at most `RECENT_S`; dtype `ANGLE_SAMPLE`."""
        samples = np.concatenate([np.empty(0, ANGLE_SAMPLE), *tuple(self._recent)])
        return samples[samples["host_time_s"] > self._clock.now_s() - duration_s]

    def angle_around(self, duration_s: float) -> float | None:
        """Median of the last seconds' angles, rad; None if there is none, or one that is no number."""
        values = self.recent(duration_s)["angle_rad"]
        return float(np.median(values)) if len(values) and np.all(np.isfinite(values)) else None

    def _scaled(self, samples: NDArray[Any]) -> NDArray[Any]:
        samples = samples.copy()
        samples["angle_rad"] = self.scale.angle_rad(samples["raw"])
        return samples

    def _placed(self, samples: NDArray[Any]) -> NDArray[Any]:
        if self._restarted:  # one that was without power counts from zero: its numbers go on where the clock is
            self._restarted = False
            self._count_on(float(samples["host_time_s"][0]))
        before = self.counts.disordered_samples
        placed = super()._placed(samples)
        self._behind = 0 if len(placed) else self._behind + self.counts.disordered_samples - before
        if self._behind >= RESTARTED:
            self._count_on(self._clock.now_s() + 1 / self.nominal_rate_hz)
            self._on_fault(f"{NAME}: its counter went back; it was without power, or what it sent comes once more")
        return placed

    def _store(self, samples: NDArray[Any]) -> None:
        samples = self._scaled(samples)
        self._write(Kind.ANGLE, samples)
        self.problem = ""
        self._remember(samples)
        self._check(samples)

    def _remember(self, samples: NDArray[Any]) -> None:
        self._measure_delay()
        numbers = samples["counter"]
        if self._unwrapper is None:
            numbers = self._total - np.arange(len(samples))[::-1]
        velocity_rad_s = self._slope.add(numbers.astype(np.int64), samples["angle_rad"])
        self.angle_rad, self.velocity_rad_s = float(samples["angle_rad"][-1]), float(velocity_rad_s[-1])
        self.live.append(np.column_stack([samples["host_time_s"], samples["angle_rad"], velocity_rad_s]))
        self._recent.append(samples)
        while self._recent[0]["host_time_s"][-1] < samples["host_time_s"][-1] - RECENT_S * self._clock.speed:
            self._recent.popleft()

    def _measure_delay(self) -> None:
        now_s, _, delay_s = self._rate[-1]
        smallest_s = delay_s
        if self._promptest is not None:
            then_s, then_delay_s = self._promptest
            smallest_s = min(delay_s, then_delay_s + RATE_TOLERANCE * (now_s - then_s))
        self._promptest, self._delay_s = (now_s, smallest_s), delay_s - smallest_s

    def start(self) -> None:
        """Open it, read it until it is gone, and so on until closed."""
        self._tasks.spawn(self._keep_open(), f"{NAME} opening")

    async def _keep_open(self) -> None:
        while not self._closing.is_set():
            try:
                self._restarted = True
                self.identity = await self.open()
            except DeviceError as error:
                self._gone(str(error))
            else:
                await self._tasks.wait(math.inf, self._closing, self._lost)
            await self._tasks.sleep(REOPEN_S, self._closing)
        await self._source.close()

    def _count_on(self, now_s: float) -> None:
        self._promptest, self._behind = None, 0
        if self._unwrapper is not None and self._previous is not None:
            passed_s = max(0.0, now_s - self._previous[1])
            self._unwrapper.resume(self._previous[0] + max(1, round(passed_s * self.nominal_rate_hz)))

    def _gone(self, reason: str) -> None:
        self.problem = reason
        self.angle_rad = self.velocity_rad_s = None

"""Clock and white noise of sensors that sample by their own clocks, and the order in which they sample."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

NOISE_BLOCK = 4096
LARGEST_JITTER_PERIODS = 0.45
"""Below one half, so that samples stay in order."""


class Noise:
    """White noise, the same for the same seed, drawn in blocks to save time."""

    def __init__(self, sd: float, seed: int) -> None:
        self._sd = sd
        self._random = np.random.default_rng(seed)
        self._block: list[float] = []

    def draw(self, count: int = 1) -> list[float]:
        """Noise of the next `count` samples, at least one, in the unit of its standard deviation."""
        while len(self._block) < count:
            self._block = (self._sd * self._random.standard_normal(NOISE_BLOCK))[::-1].tolist() + self._block
        values = self._block[: -count - 1 : -1]
        del self._block[-count:]
        return values


class SampleClock:
    """Time of a sensor's next sample, in emulated seconds, and the sensor's own clock at that time.

    Samples come at exact multiples of the period, which is off by `ppm`. With `jitter_s` each is taken, and stamped,
    off that time by this standard deviation.
    """

    def __init__(self, rate_hz: float, ppm: float, jitter_s: float, jitter_seed: int, epoch_us: int = 0) -> None:
        self.samples = 0
        self._nominal_hz, self._rate, self._epoch_us = rate_hz, 1.0 + ppm * 1e-6, epoch_us
        self._jitter_seed = jitter_seed
        self._anchor_s, self._anchor_sample, self._period_s = 0.0, 0, 1.0 / (rate_hz * self._rate)
        self._due_s = self._off_s = 0.0
        self.set_jitter(jitter_s)

    def next_s(self) -> float:
        """When the next sample is due."""
        return self._due_s

    def advance(self) -> None:
        """Go on to the next sample."""
        self.samples += 1
        largest_s = LARGEST_JITTER_PERIODS * self._period_s
        self._off_s = min(max(self._jitter.draw()[0], -largest_s), largest_s) if self._jitter else 0.0
        self._due_s = self._anchor_s + (self.samples - self._anchor_sample) * self._period_s + self._off_s

    def advance_until(self, until_s: float) -> list[float]:
        """Go on to the first sample from `until_s` on; return the times of those before it."""
        times_s = []
        while self._due_s < until_s:
            times_s.append(self._due_s)
            self.advance()
        return times_s

    def set_rate_factor(self, factor: float) -> None:
        """Sample `factor` times as fast as nominal from the next sample on."""
        self._anchor_s, self._anchor_sample = self._due_s - self._off_s, self.samples
        self._period_s = 1.0 / (self._nominal_hz * self._rate * factor)

    def set_jitter(self, sd_s: float) -> None:
        """Standard deviation of each sample's own time, from the next sample but one on."""
        self.jitter_s = sd_s
        self._jitter = Noise(sd_s, self._jitter_seed) if sd_s else None

    def time_us(self, time_s: float) -> int:
        """The sensor's clock at an emulated time."""
        return self._epoch_us + round(time_s * self._rate * 1e6)


def take_in_order(sensors: Sequence[Any], until_s: float) -> None:
    """Take all samples due before `until_s`, of all sensors in the order of their time: a limb's time only advances."""
    while True:
        first = min(sensors, key=lambda sensor: sensor.clock.next_s())
        if first.clock.next_s() >= until_s:
            return
        first.sample()

"""An absolute encoder at the joint: degrees from a zero and in a direction of its own, in steps, with noise.

    true angle = direction · scale · (raw − offset)

Raw angles do not wrap at 360 degrees. Defaults are a magnetic encoder's of 13 bits: steps of 0.044 degrees.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from stimrig.hardware_sim.load_cells.frames import AngleReading
from stimrig.hardware_sim.sampling import Noise

AngleHook = Callable[[float, float], float]
"""Takes a raw angle, degrees, and the emulated time, s; returns the raw angle that is read instead."""
NOISE_SEED = 0xA1161E


@dataclass(frozen=True)
class Mounting:
    """How the encoder sits at the joint, which a calibration finds; its steps and its noise."""

    offset_deg: float = 0.0
    direction: int = 1
    scale: float = 1.0
    bits: int = 13
    noise_deg: float = 0.02

    @property
    def step_deg(self) -> float:
        """Smallest difference between two raw angles."""
        return 360.0 / 2**self.bits

    def raw_deg(self, true_deg: float) -> float:
        """What an encoder without noise and steps reads."""
        return self.offset_deg + self.direction * true_deg / self.scale


class Encoder:
    """Reads the true angle; faults act on `hooks` and `fault`."""

    def __init__(self, angle_deg: Callable[[float], float], mounting: Mounting, noise_seed: int) -> None:
        self.hooks: list[AngleHook] = []
        self.fault = False
        self.mounting = mounting
        self._angle_deg = angle_deg
        self._noise = Noise(mounting.noise_deg, noise_seed ^ NOISE_SEED)

    def read(self, time_s: float) -> AngleReading:
        """The reading at an emulated time that never runs backwards."""
        step_deg = self.mounting.step_deg
        raw_deg = self.mounting.raw_deg(self._angle_deg(time_s)) + self._noise.next()
        raw_deg = step_deg * round(raw_deg / step_deg)
        for hook in self.hooks:
            raw_deg = hook(raw_deg, time_s)
        return AngleReading(raw_deg, self.fault)

"""Samples of the muscle's torque at multiples of the cell's own period, and their frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from hardware_sim.load_cells.frames import CellProtocol, Frame, Sample, TransportProtocol
from hardware_sim.patients.muscle import Muscle

TorqueHook = Callable[[float], float]
FrameHook = Callable[[Frame], Iterable[Frame]]
NOISE_BLOCK = 4096
LARGEST_JITTER_PERIODS = 0.45
"""Below one half, so that samples stay in order."""
JITTER_SEED = 0x7177E2


class Noise:
    """White noise, the same for the same seed, drawn in blocks to save time."""

    def __init__(self, sd_nm: float, seed: int) -> None:
        self._sd_nm = sd_nm
        self._random = np.random.default_rng(seed)
        self._block: list[float] = []

    def next_nm(self) -> float:
        """Noise of the next sample, in the unit of its standard deviation."""
        if not self._block:
            self._block = (self._sd_nm * self._random.standard_normal(NOISE_BLOCK))[::-1].tolist()
        return self._block.pop()


class LoadCell:
    """Advances the muscle and turns its torque into frames.

    Faults act on `torque_hooks` and `frame_hooks`. A torque hook changes a reading; a frame hook takes a frame and
    returns those that are sent instead. A muscle may have a method `converted_nm(reading_nm, time_s)`: the last stage
    of its cell, which comes after noise and offset (a converter that clips).

    Samples come at exact multiples of the period. With `jitter_s` each sample is taken, and its frame stamped, off that
    time by this standard deviation.
    """

    def __init__(
        self,
        muscle: Muscle,
        cell: CellProtocol,
        noise: Noise,
        rate_hz: float,
        offset_nm: float = 0.0,
        clock_ppm: float = 0.0,
        jitter_s: float = 0.0,
        has_sync: bool = True,
        epoch_us: int = 0,
    ) -> None:
        self.torque_hooks: list[TorqueHook] = []
        self.frame_hooks: list[FrameHook] = []
        self.counter = 0
        self.samples = 0
        self.torque_nm = 0.0
        self._muscle, self._cell, self._noise = muscle, cell, noise
        self._converted_nm: Callable[[float, float], float] | None = getattr(muscle, "converted_nm", None)
        self._offset_nm, self._has_sync = offset_nm, has_sync
        self._nominal_hz = rate_hz
        self._clock_rate = 1.0 + clock_ppm * 1e-6
        self._epoch_us = epoch_us
        self._sync = False
        self._held: list[Sample] = []
        self._frames: list[Frame] = []
        self._anchor_s, self._anchor_sample, self._period_s = 0.0, 0, 1.0 / (rate_hz * self._clock_rate)
        self._off_s = 0.0
        self.set_jitter(jitter_s)

    def raise_sync(self) -> None:
        """The stimulator's sync line: seen in the first sample from now on."""
        self._sync = self._has_sync

    def set_rate_factor(self, factor: float) -> None:
        """Sample `factor` times as fast as nominal from the next sample on."""
        self._anchor_s, self._anchor_sample = self._next_s() - self._off_s, self.samples
        self._period_s = 1.0 / (self._nominal_hz * self._clock_rate * factor)

    def set_jitter(self, sd_s: float) -> None:
        """Standard deviation of each sample's own time, from the next sample but one on."""
        self.jitter_s = sd_s
        self._jitter = Noise(sd_s, JITTER_SEED) if sd_s else None

    def produce(self, until_s: float) -> None:
        """Take all samples that are due before `until_s`, in emulated seconds."""
        time_s = self._next_s()
        while time_s < until_s:
            self._sample(time_s)
            time_s = self._next_s()

    def take_frames(self) -> list[Frame]:
        """The frames made since the last call."""
        frames, self._frames = self._frames, []
        return frames

    def add_frame(self, frame: Frame) -> None:
        """Send a frame that holds no new sample: a bus error, or one that a fault has delayed."""
        self._frames.append(frame)

    def time_us(self, time_s: float) -> int:
        """The cell's clock, which drifts by `clock_ppm`, at an emulated time."""
        return self._epoch_us + round(time_s * self._clock_rate * 1e6)

    def _next_s(self) -> float:
        return self._anchor_s + (self.samples - self._anchor_sample) * self._period_s + self._off_s

    def _draw_jitter(self) -> None:
        largest_s = LARGEST_JITTER_PERIODS * self._period_s
        self._off_s = min(max(self._jitter.next_nm(), -largest_s), largest_s) if self._jitter else 0.0

    def _sample(self, time_s: float) -> None:
        self.torque_nm = self._muscle.torque_nm(time_s)
        reading_nm = self.torque_nm + self._offset_nm + self._noise.next_nm()
        if self._converted_nm is not None:
            reading_nm = self._converted_nm(reading_nm, time_s)
        for hook in self.torque_hooks:
            reading_nm = hook(reading_nm)
        sample = Sample(reading_nm, self.counter, self._sync, self.time_us(time_s))
        self._sync = False
        self.samples += 1
        self.counter += 1
        self._draw_jitter()
        if not self._cell.running():
            self._held.clear()
            return
        self._held.append(sample)
        if len(self._held) >= self._cell.samples_per_frame:
            self._queue(self._cell.encode(self._held))
            self._held.clear()

    def _queue(self, frame: Frame) -> None:
        frames = [frame]
        for hook in self.frame_hooks:
            frames = [changed for one in frames for changed in hook(one)]
        self._frames += frames


def deliver(load_cell: LoadCell, transport: TransportProtocol) -> None:
    """Send the frames made since the last call."""
    frames = load_cell.take_frames()
    if frames:
        transport.send(frames)

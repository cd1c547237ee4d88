"""Samples of the muscle's torque at multiples of the cell's own period, and their frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from hardware_sim.load_cells.frames import AngleReading, CellProtocol, Frame, Sample, TransportProtocol
from hardware_sim.patients.muscle import Muscle
from hardware_sim.sampling import Noise, SampleClock

TorqueHook = Callable[[float], float]
FrameHook = Callable[[Frame], Iterable[Frame]]
JITTER_SEED = 0x7177E2


class LoadCell:
    """Advances the muscle and turns its torque into frames.

    Faults act on `torque_hooks` and `frame_hooks`. A torque hook changes a reading; a frame hook takes a frame and
    returns those that are sent instead. A muscle may have a method `converted_nm(reading_nm, time_s)`: the last stage
    of its cell, which comes after noise and offset (a converter that clips). `read_angle(time_s)` is there where the
    cell's electronics read a joint angle too; it is read after the torque.
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
        read_angle: Callable[[float], AngleReading] | None = None,
    ) -> None:
        self.torque_hooks: list[TorqueHook] = []
        self.frame_hooks: list[FrameHook] = []
        self.counter = 0
        self.torque_nm = 0.0
        self.clock = SampleClock(rate_hz, clock_ppm, jitter_s, JITTER_SEED, epoch_us)
        self._muscle, self._cell, self._noise = muscle, cell, noise
        self._converted_nm: Callable[[float, float], float] | None = getattr(muscle, "converted_nm", None)
        self._read_angle = read_angle
        self._offset_nm, self._has_sync = offset_nm, has_sync
        self._sync = False
        self._held: list[Sample] = []
        self._frames: list[Frame] = []

    def raise_sync(self) -> None:
        """The stimulator's sync line: seen in the first sample from now on."""
        self._sync = self._has_sync

    def produce(self, until_s: float) -> None:
        """Take all samples that are due before `until_s`, in emulated seconds."""
        while self.clock.next_s() < until_s:
            self.sample()

    def next_s(self) -> float:
        """When the next sample is due."""
        return self.clock.next_s()

    def take_frames(self) -> list[Frame]:
        """The frames made since the last call."""
        frames, self._frames = self._frames, []
        return frames

    def add_frame(self, frame: Frame) -> None:
        """Send a frame that holds no new sample: a bus error, or one that a fault has delayed."""
        self._frames.append(frame)

    def sample(self) -> None:
        """Take the next sample."""
        time_s = self.clock.next_s()
        self.torque_nm = self._muscle.torque_nm(time_s)
        reading_nm = self.torque_nm + self._offset_nm + self._noise.next()
        if self._converted_nm is not None:
            reading_nm = self._converted_nm(reading_nm, time_s)
        for hook in self.torque_hooks:
            reading_nm = hook(reading_nm)
        angle = self._read_angle(time_s) if self._read_angle else None
        sample = Sample(reading_nm, self.counter, self._sync, self.clock.time_us(time_s), angle)
        self._sync = False
        self.counter += 1
        self.clock.taken()
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

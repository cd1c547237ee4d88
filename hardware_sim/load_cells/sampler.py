"""Samples of the muscle's torque at multiples of the cell's own period, and their frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import chain, repeat

from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.load_cells.cells import CELLS, Cell
from stimrig.hardware_sim.load_cells.frames import AngleReading, Frame, Sample
from stimrig.hardware_sim.patients.muscle import Muscle
from stimrig.hardware_sim.sampling import Noise, SampleClock
from stimrig.hardware_sim.settings import Settings

TorqueHook = Callable[[float, float], float]
FrameHook = Callable[[Frame], Iterable[Frame]]
JITTER_SEED = 0x7177E2


class LoadCell:
    """Advances the muscle and turns its torque into frames.

    Faults act on `torque_hooks` and `frame_hooks`. A torque hook changes a reading at a time; a frame hook takes a
    frame and returns those that are sent instead. A muscle may have a method `converted_nm(reading_nm, time_s)`: the
    last stage of its cell, which comes after noise and offset (a converter that clips). `read_angle(time_s)` is there
    where the cell's electronics read a joint angle too, after the torque.
    """

    def __init__(
        self,
        muscle: Muscle,
        settings: Settings,
        epoch_us: int = 0,
        read_angle: Callable[[float], AngleReading] | None = None,
    ) -> None:
        self.torque_hooks: list[TorqueHook] = []
        self.frame_hooks: list[FrameHook] = []
        self.counter = 0
        self.torque_nm = 0.0
        self.plugged = True
        """Whether the adapter is there: frames that come while it is not are lost."""
        jitter_s = settings.clock_jitter_us * 1e-6
        self.clock = SampleClock(settings.rate_hz, settings.clock_ppm, jitter_s, JITTER_SEED, epoch_us)
        self.cell = _make_cell(settings)
        self._muscle, self._settings, self._noise = muscle, settings, Noise(settings.noise_nm, settings.noise_seed)
        converted_nm: TorqueHook | None = getattr(muscle, "converted_nm", None)
        self._converter = [converted_nm] if converted_nm else []
        self._read_angle = read_angle
        self._sync = False
        self._unsent: list[Sample] = []
        self._frames: list[Frame] = []

    def raise_sync(self) -> None:
        """The stimulator's sync line: seen in the first sample from now on."""
        self._sync = self._settings.sync

    def produce(self, until_s: float) -> None:
        """Take all samples that are due before `until_s`, in emulated seconds."""
        if self._converter or self._read_angle or self.torque_hooks or self.frame_hooks:
            while self.clock.next_s() < until_s:
                self.sample()
        elif times_s := self.clock.advance_until(until_s):
            self._read(times_s)

    def restart(self) -> None:
        """Power lost and back, with electronics as they are from power-on: what has not been taken is lost."""
        self.cell, self.counter, self._sync = _make_cell(self._settings), 0, False
        self._unsent.clear()
        self._frames.clear()

    def take_frames(self) -> list[Frame]:
        """The frames made since the last call."""
        frames, self._frames = self._frames, []
        return frames

    def add_frame(self, frame: Frame) -> None:
        """Send a frame that holds no new sample of torque: an angle, a bus error, or one that a fault has delayed."""
        self._frames += [frame] * self.plugged

    def sample(self) -> None:
        """Take the next sample."""
        time_s = self.clock.next_s()
        self.clock.advance()
        self._read([time_s])

    def _read(self, times_s: list[float]) -> None:
        """Samples at these times; one alone where a hook, a converter or an angle wants its turn."""
        torques_nm = list(map(self._muscle.torque_nm, times_s))
        self.torque_nm = torques_nm[-1]
        noise_nm = self._noise.draw(len(times_s))
        offset_nm = self._settings.torque_offset_nm
        readings_nm = [nm + offset_nm + more for nm, more in zip(torques_nm, noise_nm, strict=True)]
        for change in (*self._converter, *self.torque_hooks):
            readings_nm = [change(readings_nm[0], times_s[0])]
        angle = self._read_angle(times_s[0]) if self._read_angle else None
        counters = range(self.counter, self.counter + len(times_s))
        syncs = chain((self._sync,), repeat(False))
        self._sync, self.counter = False, counters.stop
        stamps_us = map(self.clock.time_us, times_s)
        self._send(map(Sample, readings_nm, counters, syncs, stamps_us, repeat(angle), times_s))

    def _send(self, samples: Iterable[Sample]) -> None:
        """Frames of these samples; a cell that does not run throws them away."""
        if not self.cell.running:
            self._unsent.clear()
            return
        frames, waiting, full = [], self._unsent, self.cell.samples_per_frame
        for sample in samples:
            waiting.append(sample)
            if len(waiting) >= full:
                frames.append(self.cell.encode(waiting))
                waiting.clear()
        for hook in self.frame_hooks:
            frames = [changed for frame in frames for changed in hook(frame)]
        self._frames += frames * self.plugged


def _make_cell(settings: Settings) -> Cell:
    """The cell's electronics. Raises HardwareSimError: it has no frame of so many samples."""
    kind = CELLS[settings.cell]
    if settings.samples_per_frame not in kind.layouts:
        allowed = " or ".join(map(str, kind.layouts))
        raise HardwareSimError(
            f"--samples-per-frame must be {allowed} with --cell {settings.cell}, not {settings.samples_per_frame}"
        )
    return kind(settings.samples_per_frame)

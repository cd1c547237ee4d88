"""The sensor of the joint's angle: an absolute encoder, read by the load cell's electronics or in frames of its own."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from typing import Any

from stimrig.hardware_sim.load_cells.cells import WithAngle
from stimrig.hardware_sim.load_cells.frames import AngleReading, Frame
from stimrig.hardware_sim.sampling import Noise, SampleClock
from stimrig.hardware_sim.settings import Settings

CAN_ID = 0x182
LAYOUT = struct.Struct("<fHBB")
FAULT_BIT = 0x01
NOISE_SEED, JITTER_SEED = 0xA1161E, 0xA2161E

AngleHook = Callable[[float, float], float]
"""Takes a raw angle, degrees, and the emulated time, s; returns the raw angle that is read instead."""
FrameHook = Callable[[Frame], Iterable[Frame]]


class Encoder:
    """Degrees from a zero and in a direction of its own, which a calibration finds, in steps, with noise.

        true angle = direction · scale · (raw − offset)

    Raw angles do not wrap at 360 degrees. Defaults are a magnetic encoder's of 13 bits: steps of 0.044 degrees. Faults
    act on `hooks` and `fault`.
    """

    def __init__(self, angle_deg: Callable[[float], float], settings: Settings) -> None:
        self.hooks: list[AngleHook] = []
        self.fault = False
        self.settings = settings
        self._angle_deg = angle_deg
        self._step_deg = 360.0 / 2**settings.angle_bits
        self._noise = Noise(settings.angle_noise_deg, settings.noise_seed ^ NOISE_SEED)

    def read(self, time_s: float) -> AngleReading:
        """The reading at an emulated time that never runs backwards."""
        settings = self.settings
        from_zero_deg = settings.angle_direction * self._angle_deg(time_s) / settings.angle_scale
        raw_deg = settings.angle_offset_deg + from_zero_deg + self._noise.draw()[0]
        raw_deg = self._step_deg * round(raw_deg / self._step_deg)
        for hook in self.hooks:
            raw_deg = hook(raw_deg, time_s)
        return AngleReading(raw_deg, self.fault)


class AngleSensor:
    """Turns readings into frames of its own: id 0x182, little endian, float32 degrees, 16-bit counter, status, spare.

    Always on, by a clock of its own, on the load cell's bus. The frame's status has the fault in bit 0. A frame hook
    returns the frames that are sent instead of one.
    """

    def __init__(self, encoder: Encoder, send: Callable[[Frame], None], settings: Settings, epoch_us: int = 0) -> None:
        self.frame_hooks: list[FrameHook] = []
        self.counter = 0
        jitter_s = settings.angle_jitter_us * 1e-6
        self.clock = SampleClock(settings.angle_rate_hz, settings.angle_clock_ppm, jitter_s, JITTER_SEED, epoch_us)
        self._encoder, self._send = encoder, send

    def sample(self) -> None:
        """Take the next sample and send its frame."""
        time_s = self.clock.next_s()
        reading = self._encoder.read(time_s)
        data = LAYOUT.pack(reading.angle_deg, self.counter & 0xFFFF, FAULT_BIT if reading.fault else 0, 0)
        frames = [Frame(CAN_ID, data, self.clock.time_us(time_s), time_s=time_s)]
        self.counter += 1
        self.clock.advance()
        for hook in self.frame_hooks:
            frames = [changed for frame in frames for changed in hook(frame)]
        for frame in frames:
            self._send(frame)


def describe(settings: Settings) -> dict[str, Any]:
    """Return its entry in the ready line: how it sends, and the result of a perfect calibration."""
    in_cell = settings.angle == "in-cell"
    return {
        "kind": "in_cell" if in_cell else "own",
        "frame_id": WithAngle.can_id if in_cell else CAN_ID,
        "rate_hz": settings.rate_hz if in_cell else settings.angle_rate_hz,
        "offset_deg": settings.angle_offset_deg,
        "direction": settings.angle_direction,
        "scale": settings.angle_scale,
    }

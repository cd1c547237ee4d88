"""The encoder's own CAN frames: id 0x182, little endian, float32 degrees, 16-bit counter, status, a spare byte.

Always on, by a clock of its own, on the load cell's bus. The frame's status has the fault in bit 0.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable

from stimrig.hardware_sim.angle_sensors.encoder import Encoder
from stimrig.hardware_sim.load_cells.frames import Frame
from stimrig.hardware_sim.sampling import SampleClock

CAN_ID = 0x182
LAYOUT = struct.Struct("<fHBB")
FAULT_BIT = 0x01
JITTER_SEED = 0xA2161E

FrameHook = Callable[[Frame], Iterable[Frame]]


class AngleSensor:
    """Turns readings into frames and sends them; a frame hook returns the frames that are sent instead of one."""

    def __init__(
        self,
        encoder: Encoder,
        send: Callable[[Frame], None],
        rate_hz: float = 200.0,
        clock_ppm: float = 0.0,
        jitter_s: float = 0.0,
        epoch_us: int = 0,
    ) -> None:
        self.frame_hooks: list[FrameHook] = []
        self.counter = 0
        self.clock = SampleClock(rate_hz, clock_ppm, jitter_s, JITTER_SEED, epoch_us)
        self._encoder, self._send = encoder, send

    def next_s(self) -> float:
        """When the next sample is due."""
        return self.clock.next_s()

    def sample(self) -> None:
        """Take the next sample and send its frame."""
        time_s = self.clock.next_s()
        frames = [self._frame(time_s)]
        self.counter += 1
        self.clock.taken()
        for hook in self.frame_hooks:
            frames = [changed for one in frames for changed in hook(one)]
        for frame in frames:
            self._send(frame)

    def _frame(self, time_s: float) -> Frame:
        reading = self._encoder.read(time_s)
        status = FAULT_BIT if reading.fault else 0
        data = LAYOUT.pack(reading.angle_deg, self.counter & 0xFFFF, status, 0)
        return Frame(CAN_ID, data, self.clock.time_us(time_s), time_s=time_s)

"""The default cell: id 0x181, torque in N·m as float32, 16-bit counter, status with the sync line. Always on."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from hardware_sim.load_cells.frames import Frame, Sample

CAN_ID = 0x181
LAYOUT = struct.Struct("<fHBB")
SYNC_BIT = 0x01


class Cell:
    """One sample a frame, little endian: torque, counter, status (bit 0 sync), spare."""

    samples_per_frame = 1

    def running(self) -> bool:
        """From power-on."""
        return True

    def encode(self, samples: Sequence[Sample]) -> Frame:
        """The frame of one sample."""
        sample = samples[0]
        status = SYNC_BIT if sample.sync else 0
        data = LAYOUT.pack(sample.torque_nm, sample.counter & 0xFFFF, status, 0)
        return Frame(CAN_ID, data, sample.time_us)

    def received(self, can_id: int, data: bytes) -> None:
        """Takes no commands."""

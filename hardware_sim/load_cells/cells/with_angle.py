"""A cell whose electronics read the joint's angle too: id 0x181, both in one frame and by one clock. Always on.

Little endian: float32 torque in N·m, int16 raw angle in 0.01 degrees, 8-bit counter, status (bit 0 sync, bit 1 fault of
the angle). The default cell's frame has one free byte only, so that one could not carry the angle.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from stimrig.hardware_sim.load_cells.frames import AlwaysOn, Frame, Sample

CAN_ID = 0x181
LAYOUT = struct.Struct("<fhBB")
SYNC_BIT, FAULT_BIT = 0x01, 0x02
COUNTS_PER_DEG = 100
LARGEST_COUNTS, NO_ANGLE = 32767, -32768


class Cell(AlwaysOn):
    """One sample a frame; an angle that is no number is the lowest count."""

    layouts: tuple[int, ...] = (1,)
    has_counter = has_sync = True

    def encode(self, samples: Sequence[Sample]) -> Frame:
        """The frame of one sample."""
        sample = samples[0]
        status = (SYNC_BIT if sample.sync else 0) | (FAULT_BIT if sample.angle and sample.angle.fault else 0)
        counts = _counts(sample.angle.angle_deg if sample.angle else math.nan)
        data = LAYOUT.pack(sample.torque_nm, counts, sample.counter & 0xFF, status)
        return Frame(CAN_ID, data, sample.time_us, time_s=sample.time_s)


def _counts(angle_deg: float) -> int:
    if not math.isfinite(angle_deg):
        return NO_ANGLE
    return min(max(round(angle_deg * COUNTS_PER_DEG), -LARGEST_COUNTS), LARGEST_COUNTS)

"""The default cell: id 0x181, torque in N·m as float32, 16-bit counter, status with the sync line. Always on.

With three samples per frame: three int16 counts of 2 mN·m and a 16-bit counter of frames, without the sync line.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from stimrig.hardware_sim.load_cells.frames import AlwaysOn, Frame, Sample

CAN_ID = 0x181
LAYOUT = struct.Struct("<fHBB")
SYNC_BIT = 0x01
PACKED = struct.Struct("<hhhH")
PACKED_SAMPLES = 3
COUNTS_PER_NM = 500
LARGEST_COUNTS = 32767


class Cell(AlwaysOn):
    """Little endian: torque, counter, status (bit 0 sync), spare; or three counts and a counter."""

    layouts: tuple[int, ...] = (1, PACKED_SAMPLES)
    has_counter = True

    def __init__(self, samples_per_frame: int = 1) -> None:
        super().__init__(samples_per_frame)
        self.has_sync = samples_per_frame == 1

    def encode(self, samples: Sequence[Sample]) -> Frame:
        """The frame of its samples."""
        last = samples[-1]
        if len(samples) == PACKED_SAMPLES:
            data = PACKED.pack(*(_counts(one.torque_nm) for one in samples), last.counter // PACKED_SAMPLES & 0xFFFF)
        else:
            data = LAYOUT.pack(last.torque_nm, last.counter & 0xFFFF, SYNC_BIT if last.sync else 0, 0)
        return Frame(CAN_ID, data, last.time_us, False, last.time_s)


def _counts(torque_nm: float) -> int:
    """Counts, limited to full scale; NaN is the lowest count."""
    counts = round(torque_nm * COUNTS_PER_NM) if math.isfinite(torque_nm) else -LARGEST_COUNTS
    return min(max(counts, -LARGEST_COUNTS), LARGEST_COUNTS)

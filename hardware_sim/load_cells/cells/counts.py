"""A cell like ME's GSV-4: id 610, 16-bit counts, big endian, no counter and no sync line. Always on.

Counts are offset binary: 32768 is zero, full scale 50 N·m. Several samples of a frame follow one another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from stimrig.hardware_sim.load_cells.frames import AlwaysOn, Frame, Sample

CAN_ID = 610
ZERO_COUNTS = 32768
COUNTS_PER_NM = 32767 / 50.0


class Cell(AlwaysOn):
    """2 bytes a sample."""

    layouts: tuple[int, ...] = (1, 2, 3, 4)
    has_counter = has_sync = False

    def encode(self, samples: Sequence[Sample]) -> Frame:
        """The frame of its samples; values are limited to full scale, NaN is the lowest count."""
        data = b"".join(_counts(sample.torque_nm).to_bytes(2, "big") for sample in samples)
        return Frame(CAN_ID, data, samples[-1].time_us, time_s=samples[-1].time_s)


def _counts(torque_nm: float) -> int:
    counts = ZERO_COUNTS + round(torque_nm * COUNTS_PER_NM) if math.isfinite(torque_nm) else 0
    return min(max(counts, 0), 0xFFFF)

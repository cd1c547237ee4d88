"""A cell like ME's GSV-4: id 610, 16-bit counts, big endian, no counter and no sync line. Always on.

Counts are offset binary: 32768 is zero, full scale 50 N·m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from hardware_sim.load_cells.frames import Frame, Sample

CAN_ID = 610
ZERO_COUNTS = 32768
COUNTS_PER_NM = 32767 / 50.0


class Cell:
    """One sample a frame of 2 bytes."""

    samples_per_frame = 1

    def running(self) -> bool:
        """From power-on."""
        return True

    def encode(self, samples: Sequence[Sample]) -> Frame:
        """The frame of one sample; a value beyond full scale, or none, sits at the stop."""
        torque_nm = samples[0].torque_nm
        counts = ZERO_COUNTS + round(torque_nm * COUNTS_PER_NM) if math.isfinite(torque_nm) else 0
        return Frame(CAN_ID, min(max(counts, 0), 0xFFFF).to_bytes(2, "big"), samples[0].time_us)

    def received(self, can_id: int, data: bytes) -> None:
        """Takes no commands."""

"""A CANopen cell, node 1: float32 and counter in TPDO1 (0x181), sent only after NMT start (000#0100 or 000#0101).

NMT: 01 start, 02 stop, 80 pre-operational, 81 and 82 reset; node 0 means all (CiA 301).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from stimrig.hardware_sim.load_cells.frames import Frame, Sample

NODE = 1
NMT_ID = 0x000
TPDO1_ID = 0x180 + NODE
LAYOUT = struct.Struct("<fHBB")
START = 0x01
LEAVE = (0x02, 0x80, 0x81, 0x82)


class Cell:
    """The default cell's layout behind a start command."""

    layouts: tuple[int, ...] = (1,)
    has_counter = has_sync = True

    def __init__(self, samples_per_frame: int = 1) -> None:
        self.samples_per_frame = samples_per_frame
        self._operational = False

    def running(self) -> bool:
        """Between NMT start and any command that leaves the operational state."""
        return self._operational

    def encode(self, samples: Sequence[Sample]) -> Frame:
        """TPDO1 of one sample."""
        sample = samples[0]
        data = LAYOUT.pack(sample.torque_nm, sample.counter & 0xFFFF, int(sample.sync), 0)
        return Frame(TPDO1_ID, data, sample.time_us, time_s=sample.time_s)

    def received(self, can_id: int, data: bytes) -> None:
        """NMT commands for this node or for all."""
        if can_id == NMT_ID and len(data) == 2 and data[1] in (0, NODE):
            if data[0] == START:
                self._operational = True
            elif data[0] in LEAVE:
                self._operational = False

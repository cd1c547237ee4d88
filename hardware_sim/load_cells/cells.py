"""The electronics of load cells: how samples become CAN frames, and what starts and stops them.

A cell's constructor takes the number of samples per frame, one of its `layouts`; each of those has the keys by which a
rig file describes the cell then. A frame's time is that of its last sample.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any, ClassVar

from stimrig.hardware_sim.load_cells.frames import AngleReading, Frame, Sample

TORQUE = struct.Struct("<fHBB")
"""Little endian: torque in N·m, counter, status, spare."""


def _packed(dbc: str, samples: int, counter: str) -> dict[str, Any]:
    return {"dbc": dbc, "signal": [f"Torque{i + 1}_Nm" for i in range(samples)], "counter": counter, "sync": ""}


class Cell:
    """A cell that sends from power-on and takes no commands."""

    name: ClassVar[str]
    can_id: ClassVar[int]
    layouts: ClassVar[dict[int, dict[str, Any]]] = {1: {}}

    def __init__(self, samples_per_frame: int = 1) -> None:
        self.samples_per_frame = samples_per_frame
        self.rig_keys = self.layouts[samples_per_frame]
        self.has_counter, self.has_sync = (self.rig_keys.get(key) != "" for key in ("counter", "sync"))
        self.running = True
        """True while it sends."""

    def encode(self, samples: Sequence[Sample]) -> Frame:
        """The frame of `samples_per_frame` samples."""
        return Frame(self.can_id, self.pack(samples), samples[-1].time_us, time_s=samples[-1].time_s)

    def pack(self, samples: Sequence[Sample]) -> bytes:
        """The data of that frame."""
        raise NotImplementedError

    def received(self, can_id: int, data: bytes) -> None:
        """A frame from the host."""


class Plain(Cell):
    """The default: id 0x181, torque in N·m as float32, 16-bit counter, status with the sync line in bit 0.

    With three samples per frame: three int16 counts of 2 mN·m and a 16-bit counter of frames, without the sync line.
    """

    name, can_id, layouts = "plain", 0x181, {1: {}, 3: _packed("torque_packed3", 3, "Counter")}

    def pack(self, samples: Sequence[Sample]) -> bytes:
        last = samples[-1]
        if len(samples) == 1:
            return TORQUE.pack(last.torque_nm, last.counter & 0xFFFF, int(last.sync), 0)
        counts = (_counts(sample.torque_nm, per_unit=500, nothing=-32767) for sample in samples)
        return struct.pack("<hhhH", *counts, last.counter // self.samples_per_frame & 0xFFFF)


class Counts(Cell):
    """Like ME's GSV-4: id 610, big endian, no counter and no sync line; several samples of a frame follow one another.

    16-bit counts in offset binary, limited to full scale: 32768 is zero, full scale 50 N·m, NaN the lowest count.
    """

    name, can_id, layouts = "counts", 610, {count: _packed("counts_be16", count, "") for count in (1, 2, 3, 4)}

    def pack(self, samples: Sequence[Sample]) -> bytes:
        values = (sample.torque_nm for sample in samples)
        counts = (32768 + round(nm * (32767 / 50.0)) if math.isfinite(nm) else 0 for nm in values)
        return struct.pack(f">{len(samples)}H", *(min(max(count, 0), 0xFFFF) for count in counts))


class CanOpen(Plain):
    """A CANopen cell, node 1: the default's layout in TPDO1 (0x181), sent only after NMT start (000#0100 or 000#0101).

    NMT: 01 start, 02 stop, 80 pre-operational, 81 and 82 reset; node 0 means all (CiA 301).
    """

    NODE, START, STOP_COMMANDS = 1, 0x01, (0x02, 0x80, 0x81, 0x82)

    name, can_id, layouts = "canopen", 0x180 + NODE, {1: {"start_frames": ["000#0101"], "stop_frames": ["000#0201"]}}

    def __init__(self, samples_per_frame: int = 1) -> None:
        super().__init__(samples_per_frame)
        self.running = False

    def received(self, can_id: int, data: bytes) -> None:
        """NMT commands for this node or for all."""
        if can_id == 0 and len(data) == 2 and data[1] in (0, self.NODE):
            self.running = data[0] == self.START or (self.running and data[0] not in self.STOP_COMMANDS)


class WithAngle(Cell):
    """Its electronics read the joint's angle too: id 0x181, both in one frame and by one clock.

    Little endian: float32 torque in N·m, int16 raw angle in 0.01 degrees (an angle that is no number is the lowest
    count), 8-bit counter, status (bit 0 sync, bit 1 fault of the angle). The default cell's frame has one free byte
    only, so that one could not carry the angle.
    """

    name, can_id, layouts = "with_angle", 0x181, {1: {"dbc": "torque_with_angle"}}

    def pack(self, samples: Sequence[Sample]) -> bytes:
        sample = samples[0]
        angle = sample.angle or AngleReading(math.nan, fault=False)
        counts, status = _counts(angle.angle_deg, per_unit=100, nothing=-32768), int(sample.sync) | 2 * angle.fault
        return struct.pack("<fhBB", sample.torque_nm, counts, sample.counter & 0xFF, status)


def _counts(value: float, per_unit: float, nothing: int) -> int:
    """Signed counts, limited to full scale; `nothing` for what is no number."""
    return min(max(round(value * per_unit), -32767), 32767) if math.isfinite(value) else nothing


CELLS: dict[str, type[Cell]] = {
    cell.name: cell for cell in sorted([*Cell.__subclasses__(), *Plain.__subclasses__()], key=lambda cell: cell.name)
}
"""By name, in alphabetical order."""

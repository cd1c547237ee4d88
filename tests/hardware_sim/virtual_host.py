"""A host of emulated devices in virtual time: no process, no port, no waiting."""

from __future__ import annotations

import struct
from itertools import pairwise
from typing import Any

from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.load_cells.frames import Frame
from stimrig.hardware_sim.settings import Settings
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode4

LAYOUT = struct.Struct("<fHBB")


class VirtualHost:
    def __init__(self, arm: str | None = None, **settings: Any) -> None:
        self.devices = make_devices(Settings(**settings), arm)
        self.answered_s = 0.0
        self._decoder = ScienceMode4()

    def ask(self, command: int, data: bytes = b"", wait_s: float = 0.25) -> list[Packet]:
        self.devices.received(self.devices.timeline.now_s, ScienceMode4.encode(Packet(1, command, data)))
        return self.read(wait_s)

    def read(self, wait_s: float = 0.25) -> list[Packet]:
        self.devices.advance(self.devices.timeline.now_s + wait_s)
        self.devices.take_frames()
        packets = []
        for time_s, data in self.devices.take_bytes():
            packets += self._decoder.feed(data, time_s)
            self.answered_s = time_s
        return packets

    def result(self, command: int, data: bytes = b"") -> int:
        (packet,) = self.ask(command, data)
        return packet.data[0]

    def frames(self, seconds: float = 0.5) -> list[Frame]:
        """The frames of the next while."""
        self.devices.advance(self.devices.timeline.now_s + seconds)
        return self.devices.take_frames()

    def samples(self, seconds: float = 0.5) -> list[tuple[float, int, int, int]]:
        return [LAYOUT.unpack(frame.data) for frame in self.frames(seconds) if not frame.error]

    def steps(self) -> list[int]:
        return [(after[1] - before[1]) & 0xFFFF for before, after in pairwise(self.samples())]

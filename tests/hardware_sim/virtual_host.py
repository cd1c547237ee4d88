"""A host of emulated devices in virtual time: no process, no port, no waiting."""

from __future__ import annotations

import struct
from itertools import pairwise
from typing import Any

from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.load_cells.frames import Frame
from stimrig.hardware_sim.settings import Settings
from stimrig.hardware_sim.stimulators.board import Point
from stimrig.hardware_sim.stimulators.sciencemode import Packet

LAYOUT = struct.Struct("<fHBB")
LL_INIT, LL_CONFIG, LL_STOP = 0, 2, 4
ML_INIT, ML_UPDATE, ML_STOP, ML_DATA = 30, 32, 34, 36


class VirtualHost:
    def __init__(self, arm: str | None = None, **settings: Any) -> None:
        self.devices = make_devices(Settings(**settings), arm)
        self.timeline, self.board, self.electrodes = self.devices.timeline, self.devices.board, self.devices.electrodes
        self.firmware: Any = self.devices.firmware
        self.sent: list[tuple[float, Packet]] = []
        """Time and packet of everything that the stimulator has sent."""
        self._decoder = self.firmware.wire()

    @property
    def pulses(self) -> list[tuple[float, float, float]]:
        """Time, width and current of each pulse that flowed."""
        return [(one.time_s, one.width_us, one.current_ma) for one in self.electrodes.log if one.delivered]

    def send(self, command: int, data: bytes = b"", number: int = 9) -> None:
        self.receive(self._decoder.encode(Packet(number, command, data)))

    def receive(self, data: bytes) -> None:
        self.devices.received(self.timeline.now_s, data)
        self.run(0.0)

    def run(self, seconds: float) -> None:
        """Let time pass, and read what the stimulator writes as it comes."""
        end_s = self.timeline.now_s + seconds
        while (event_s := self.devices.next_s()) is not None and event_s <= end_s:
            self._advance(event_s)
        self._advance(end_s)
        self.devices.take_frames()

    def answers(self, command: int, data: bytes = b"", wait_s: float = 0.25) -> list[Packet]:
        """All that comes within a while after a command."""
        before = len(self.sent)
        self.send(command, data)
        self.run(wait_s)
        return [packet for _, packet in self.sent[before:]]

    def ask(self, command: int, data: bytes = b"", number: int = 9, wait_s: float = 0.05) -> Packet:
        """The answer to one command, which must be the only one."""
        before = len(self.sent)
        self.send(command, data, number)
        self.run(wait_s)
        assert len(self.sent) == before + 1
        return self.sent[-1][1]

    def result(self, command: int, data: bytes = b"") -> int:
        return self.ask(command, data, wait_s=0.25).data[0]

    def frames(self, seconds: float = 0.5) -> list[Frame]:
        """The frames of the next while."""
        self.devices.advance(self.timeline.now_s + seconds)
        return self.devices.take_frames()

    def samples(self, seconds: float = 0.5) -> list[tuple[float, int, int, int]]:
        return [LAYOUT.unpack(frame.data) for frame in self.frames(seconds) if not frame.error]

    def steps(self) -> list[int]:
        return [(after[1] - before[1]) & 0xFFFF for before, after in pairwise(self.samples())]

    def _advance(self, time_s: float) -> None:
        self.devices.advance(time_s)
        for written_s, data in self.devices.take_bytes():
            self.sent += [(written_s, packet) for packet in self._decoder.feed(data, written_s)]


def points(*shape: Point) -> bytes:
    return b"".join((w << 20 | round(2 * i + 300) << 10).to_bytes(4, "big") for w, i in shape)


def biphasic(width_us: int, current_ma: float) -> list[Point]:
    return [(width_us, current_ma), (100, 0.0), (width_us, -current_ma)]


def config(*shape: Point, execute: bool = True, channel: int = 0, connector: int = 0) -> bytes:
    return bytes((execute << 7 | channel << 5 | connector << 4 | len(shape) - 1,)) + points(*shape)

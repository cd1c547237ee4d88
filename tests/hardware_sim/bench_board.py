"""A stimulator on a virtual clock, with a muscle that only takes notes."""

from __future__ import annotations

from typing import Any

from stimrig.hardware_sim.stimulators.board import Board, Electrodes, Firmware, Point
from stimrig.hardware_sim.stimulators.p24 import P24
from stimrig.hardware_sim.stimulators.sciencemode import Packet
from stimrig.hardware_sim.timeline import Timeline

LL_INIT, LL_CONFIG, LL_STOP = 0, 2, 4
ML_INIT, ML_UPDATE, ML_STOP, ML_DATA = 30, 32, 34, 36


class NotingMuscle:
    def __init__(self) -> None:
        self.pulses: list[tuple[float, float, float]] = []

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        self.pulses.append((time_s, width_us, current_ma))

    def torque_nm(self, time_s: float) -> float:
        return 0.0 * time_s


class Bench:
    def __init__(self, firmware: type[Firmware] = P24) -> None:
        self.timeline = Timeline()
        self.muscle = NotingMuscle()
        self.syncs: list[float] = []
        self.electrodes = Electrodes(self.muscle, lambda: self.syncs.append(self.timeline.now_s))
        self.sent: list[tuple[float, Packet]] = []
        self.unread = 0
        self._decoder = firmware.wire()
        self.board = Board(self.timeline, self.electrodes, self._take, lambda: self.unread)
        self.firmware: Any = firmware(self.board)

    def _take(self, frame: bytes) -> None:
        now_s = self.timeline.now_s
        self.sent += [(now_s, packet) for packet in self._decoder.feed(frame, now_s)]

    def send(self, command: int, data: bytes = b"", number: int = 9) -> None:
        self.firmware.received(self._decoder.encode(Packet(number, command, data)))

    def run(self, seconds: float) -> None:
        self.timeline.run_until(self.timeline.now_s + seconds)

    def ask(self, command: int, data: bytes = b"", number: int = 9, wait_s: float = 0.05) -> Packet:
        """The answer to one command, which must be the only one."""
        before = len(self.sent)
        self.send(command, data, number)
        self.run(wait_s)
        assert len(self.sent) == before + 1
        return self.sent[-1][1]


def points(*shape: Point) -> bytes:
    return b"".join((w << 20 | round(2 * i + 300) << 10).to_bytes(4, "big") for w, i in shape)


def biphasic(width_us: int, current_ma: float) -> list[Point]:
    return [(width_us, current_ma), (100, 0.0), (width_us, -current_ma)]


def config(*shape: Point, execute: bool = True, channel: int = 0, connector: int = 0) -> bytes:
    return bytes((execute << 7 | channel << 5 | connector << 4 | len(shape) - 1,)) + points(*shape)

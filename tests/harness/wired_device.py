"""Both drivers against both emulated stimulators in one thread on a virtual clock, with a line of random delays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hardware_sim.electrodes import Electrodes, FiredPulse
from hardware_sim.stimulators import p24 as p24_device
from hardware_sim.stimulators import rehastim2 as rehastim2_device
from hardware_sim.stimulators.board import Board
from hardware_sim.stimulators.sciencemode2 import encode as encode2
from hardware_sim.timeline import Timeline
from rig.clock import VirtualClock
from rig.devices import p24, rehastim2
from rig.errors import DeviceError
from rig.signals import LateError
from rig.wire import sciencemode2, sciencemode4
from rig.wire.framing import Packet

LOST = "stimulator: the line is gone"
QUICK_S, STALL_S, STALLS = 0.0008, 0.3, 0.02
"""A byte's usual way, the longest stall, and how often one begins."""


class NoMuscle:
    """Takes pulses and gives no torque."""

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """Forget."""

    def torque_nm(self, time_s: float) -> float:
        """None."""
        return 0.0 * time_s


class WiredDevice:
    """A real driver, an emulated device, and between them a line that keeps its order and sometimes stalls.

    It stands where the driver's own serial line does, and has the methods of one that the driver uses for pulses.
    """

    def __init__(self, name: str, clock: VirtualClock, rng: np.random.Generator, stalls: float = STALLS) -> None:
        self._stalls, self._is_lost = stalls, False
        self.last_written_s = clock.now_s()
        self._clock, self._rng = clock, rng
        self._timeline, self._began_s = Timeline(), clock.now_s()
        self.electrodes = Electrodes(NoMuscle())
        board = Board(self._timeline, self.electrodes, lambda frame: self._carry(1, lambda: self._answer(frame)))
        self._arrives_s = [0.0, 0.0]
        self._number = 0
        self._answered: dict[tuple[int, int], Packet] = {}
        if name == "p24":
            self._firmware = p24_device.Firmware(board)
            self._reader = sciencemode4.FRAMING.reader()
            self._numbers = sciencemode4.NUMBERS
            driver = p24.create(p24.Settings(device="p24", port="none"), clock)
        else:
            self._firmware = rehastim2_device.Firmware(board)
            self._reader, self._numbers = sciencemode2.FRAMING.reader(), sciencemode2.NUMBERS
            driver = rehastim2.create(rehastim2.Settings(device="rehastim2", port="none"), clock)
            self._clock.wait(self._began_s + 0.6)
            self._timeline.run_until(0.6)  # it offers a connection
            self._firmware.received(encode2(rehastim2_device.Packet(0, rehastim2_device.INIT_ACK, b"\x00")))
        driver._line = self  # type: ignore[assignment]
        self.driver = driver

    @property
    def felt(self) -> list[FiredPulse]:
        """What the electrodes felt, in order."""
        return self.electrodes.log

    def tell(self, make: Callable[[int], bytes], latest_s: float | None = None) -> int:
        """As `PacketLine.tell`."""
        if latest_s is not None and not (self._clock.now_s() <= latest_s):
            raise LateError
        if self._is_lost:
            raise DeviceError(LOST)
        self._number = (self._number + 1) % self._numbers
        frame = make(self._number)
        self.last_written_s = self._clock.now_s()
        self._carry(0, lambda: self._receive(frame))
        return self._number

    def ask(self, make: Callable[[int], bytes], name: str, answer: int, _timeout_s: float) -> Packet:
        """As `PacketLine.ask`, with all the time it takes."""
        number = self.tell(make)
        self._clock.wait(self._clock.now_s() + (2.5 * STALL_S if self._stalls else 10 * QUICK_S))
        packet = self._answered.pop((number, answer), None)
        if packet is None:
            raise DeviceError(LOST if self._is_lost else f"stimulator: no answer to {name}")
        return packet

    def discard(self) -> None:
        """What was written is in the line, not in this computer."""

    def on_lost(self, _: Callable[[str], None]) -> None:
        """`lose` is told to the rig by who calls it."""

    def lose(self) -> None:
        """Pull the plug: nothing more is written, and what the line holds does not arrive."""
        self._is_lost = True

    def close(self) -> None:
        """Nothing to close."""

    def _carry(self, way: int, arrive: Callable[[], None]) -> None:
        stalls = self._rng.random() < self._stalls
        delay_s = self._rng.uniform(0.0, STALL_S if stalls else QUICK_S)
        self._arrives_s[way] = max(self._arrives_s[way], self._clock.now_s() + delay_s)
        self._clock.call_at(self._arrives_s[way], lambda: None if self._is_lost else arrive())

    def _receive(self, frame: bytes) -> None:
        self._timeline.run_until(self._clock.now_s() - self._began_s)
        self._firmware.received(frame)
        self._go_on()

    def _go_on(self) -> None:
        """Let the device do what it has begun when its time comes."""
        following_s = self._timeline.next_s()
        if following_s is not None:
            self._clock.call_at(following_s + self._began_s, lambda: self._due(following_s))

    def _due(self, time_s: float) -> None:
        if self._timeline.now_s < time_s:
            self._timeline.run_until(time_s)
            self._go_on()

    def _answer(self, frame: bytes) -> None:
        for packet in self._reader.feed(frame):
            self.driver._take(packet, self._clock.now_s())
            self._answered[packet.number, packet.command] = packet

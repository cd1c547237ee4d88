"""The wires between the rig's computer and the emulated devices: a serial line and a CAN bus."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Sequence
from typing import Any

from stimrig.hardware_sim.devices import Devices
from stimrig.rig.errors import DeviceError
from stimrig.rig.machine import Bus, Frame, Listener, OnMessage, Port
from tests.simulator.host import Process
from tests.simulator.world import World

TRANSIT_S = 0.0002, 0.0008
"""How long a piece of bytes is on the line."""
MOST_HELD_BYTES = 4096
"""What a computer holds for a line that takes nothing; then it takes no more."""


class Direction:
    """One direction of the line. What befalls it: `stall`, and the deviances with their probabilities.

    `deliver`: gets each piece that arrives: its bytes, when it was written (world's time), whether it came as sent.
    """

    def __init__(self, world: World, name: str, deliver: Callable[[bytes, float, bool], None]) -> None:
        self.world, self.name = world, name
        self.odds: dict[str, float] = {}
        self.held: list[tuple[bytes, float]] = []
        self.discards = True
        """Whether what is held waits in the sender's computer, where it can be discarded."""
        self.left_late_s: dict[float, float] = {}
        """When a piece that had waited in the sender's computer left it, by when it was written."""
        self._stalled_until_s, self._last_s = 0.0, 0.0
        self._deliver = deliver

    def stall(self, duration_s: float, discards: bool) -> None:
        """Hold what comes for a while, then let it go at once."""
        self._stalled_until_s = max(self._stalled_until_s, self.world.now_s + duration_s)
        self.discards = discards and (self.discards or not self.held)  # what is held beyond stays there
        self.world.at(self._stalled_until_s, self._release)

    @property
    def stalled(self) -> bool:
        """Whether it holds what comes."""
        return self.world.now_s < self._stalled_until_s

    def send(self, data: bytes, written_s: float) -> None:
        """A piece that is written at a time, now or a little later."""
        if self.stalled or self.held:
            self.held.append((data, written_s))
            return
        for piece, true in self._befallen(data, written_s):
            arrives_s = max(written_s + self.world.chance.uniform(*TRANSIT_S), self._last_s)
            if true or self.odds.get("reorder", 0.0) == 0.0:
                self._last_s = arrives_s
            self.world.at(arrives_s, lambda piece=piece, true=true: self._deliver(piece, written_s, true))

    def _release(self) -> None:
        if not self.stalled:
            held, self.held = self.held, []
            if self.discards:
                self.left_late_s |= {written_s: self.world.now_s for _, written_s in held}
            for data, written_s in held:
                self.world.after(1e-5, lambda data=data, written_s=written_s: self._deliver(data, written_s, True))

    def _befallen(self, data: bytes, written_s: float) -> list[tuple[bytes, bool]]:
        """The pieces as which it arrives, and whether each is as it was sent."""
        chance, found = self.world.chance, [(data, True)]
        for deviance, odds in self.odds.items():
            if chance.random() >= odds:
                continue
            self.world.tell(self.name, deviance)
            self.world.faults += 1
            match deviance:
                case "drop":
                    found = []
                case "double":
                    found = [(data, True), (data, False)]
                case "corrupt":
                    at, bit = chance.randrange(len(data)), 1 << chance.randrange(8)
                    found = [(data[:at] + bytes([data[at] ^ bit]) + data[at + 1 :], False)]
                case "tear":
                    at = chance.randint(0, len(data))
                    found = [(data[:at], True), (data[at:], True)]
                case _:  # reorder: it comes later than what follows it
                    found = []
                    late_s = chance.uniform(0.001, 0.05)
                    self.world.after(late_s, lambda: self._deliver(data, written_s, False))
        return [piece for piece in found if piece[0]]


class Wires:
    """Serial line and CAN bus of one rig, on which `devices` hang.

    `fired`: called after a piece of bytes has reached the stimulator: when it was written, whether it came as sent.
    """

    def __init__(self, world: World, devices: Devices, block_s: float, fired: Callable[[float, bool], None]) -> None:
        self.world, self.devices, self._fired = world, devices, fired
        self.to_device = Direction(world, "line>", self._to_stimulator)
        self.to_host = Direction(world, "line<", self._to_rig)
        self.bus_stalled_until_s = 0.0
        self.decided_s: dict[float, float] = {}
        """When each command was decided, by when it was written: in between the step that writes it may be stalled."""
        self.heard: list[tuple[float, float]] = []
        """What the rig's process took from the line: when it was sent, and when it was taken."""
        self.read_s: dict[int, list[float]] = {}
        """When the rig's process read frames, by their number."""
        self._block_s = block_s
        self._port: SimulatedPort | None = None
        self._bus: _SimulatedBus | None = None
        self._next_event_s: float | None = None
        self._last = 0.0, True
        devices.on_stimulator_cable = self._stimulator_cable
        devices.on_cell_cable = self._cell_cable
        world.after(block_s, self._sample)

    def port(self, process: Process, path: str) -> Port:
        return SimulatedPort(self, process, path)

    def open_bus(self, process: Process, arguments: dict[str, Any], name: str) -> Bus:
        if not self.devices.load_cell.plugged:
            raise DeviceError(f"{name.replace(' ', '_')}.bus: the adapter is missing; plug it in")
        self._bus = _SimulatedBus(self, process, arguments)
        return self._bus

    def shared_bus(self, process: Process) -> Bus | None:
        return self._bus if self._bus is not None and self._bus.process is process else None

    def open_port(self, port: SimulatedPort) -> None:
        """This port has the line from now on."""
        if not self.devices.stimulator_plugged:
            raise DeviceError(f"stimulator.port: {port.path} is missing; plug in the stimulator or correct the port")
        self._port = port

    def pump(self) -> None:
        """Carry on what the devices have written, and come back at their next event."""
        for time_s, data in self.devices.take_bytes():
            self.to_host.send(data, max(time_s, self.world.now_s))
        next_s = self.devices.next_s()
        if next_s is not None and (self._next_event_s is None or next_s < self._next_event_s):
            self._next_event_s = next_s
            self.world.at(next_s, lambda: self._event(next_s))

    def _event(self, time_s: float) -> None:
        if self._next_event_s == time_s:
            self._next_event_s = None
            self._advance()
            self.pump()

    def _to_stimulator(self, data: bytes, written_s: float, true: bool) -> None:
        self._advance()
        self._last = written_s, true
        self.devices.received(self.world.now_s, data)
        self._fired(*self._last)
        self.pump()

    def _advance(self) -> None:
        """What the devices do by themselves until now; a pulse is one of the last piece that came."""
        self.devices.advance(self.world.now_s)
        self._fired(*self._last)

    def _to_rig(self, data: bytes, written_s: float, _true: bool) -> None:
        port = self._port
        if port is not None and port.on_bytes is not None:
            port.process.post(lambda: port.take(data, written_s))

    def _sample(self) -> None:
        self._advance()
        if self.world.now_s >= self.bus_stalled_until_s:
            frames = self.devices.take_frames()
            if self._bus is not None and frames:
                self._bus.carry(frames)
        self.pump()
        self.world.after(self._block_s, self._sample)

    def _stimulator_cable(self, plugged: bool) -> None:
        if not plugged and self._port is not None:
            port, self._port = self._port, None
            port.lose("the connection was lost (unplugged)")

    def _cell_cable(self, plugged: bool) -> None:
        if not plugged and self._bus is not None:
            bus, self._bus = self._bus, None
            bus.lose("load cell: the bus was lost: unplugged")


class SimulatedPort:
    """See `stimrig.rig.machine.Port`."""

    def __init__(self, wires: Wires, process: Process, path: str) -> None:
        self.process, self.path, self._wires = process, path, wires
        self.on_bytes: Callable[[bytes, float], None] | None = None
        self._on_lost: OnMessage = lambda _: None

    def open(self, on_bytes: Callable[[bytes, float], None], on_lost: OnMessage) -> None:
        self._wires.open_port(self)
        self.on_bytes, self._on_lost = on_bytes, on_lost

    def write(self, data: bytes) -> int:
        decided_s = self.process.computer.true_s
        self.process.computer.access()
        if self.on_bytes is None:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        line = self._wires.to_device
        if sum(len(piece) for piece, _ in line.held) + len(data) > MOST_HELD_BYTES:
            return 0
        written_s = self.process.computer.true_s
        self._wires.decided_s[written_s] = decided_s
        line.send(data, written_s)
        return len(data)

    def discard(self) -> None:
        if self._wires.to_device.discards:
            self._wires.to_device.held.clear()

    def close(self) -> None:
        self.on_bytes = None

    def take(self, data: bytes, sent_s: float) -> None:
        """Bytes that have come, in the process's own time."""
        if self.on_bytes is not None:
            self._wires.heard.append((sent_s, self.process.computer.true_s))
            self.on_bytes(data, self.process.computer.now_s())

    def lose(self, reason: str) -> None:
        """The cable is pulled."""
        if self.on_bytes is not None:
            self.on_bytes = None
            self.process.post(lambda: self._on_lost(reason))


class _SimulatedBus:
    """See `stimrig.rig.machine.Bus`."""

    place = "simulated can0"

    def __init__(self, wires: Wires, process: Process, arguments: dict[str, Any]) -> None:
        self.process, self.arguments, self._wires = process, arguments, wires
        self._listening: list[Listener] = []
        self._open = True

    def listen(self, listener: Listener) -> None:
        self._listening.append(listener)

    def detach(self, listener: Listener) -> None:
        self._listening = [other for other in self._listening if other is not listener]

    def send(self, frames: Sequence[tuple[int, bytes, bool]]) -> None:
        if not self._open:
            raise DeviceError("load cell: frame not sent: unplugged")
        for frame_id, data, _ in frames:
            self._wires.devices.frame_received(self._wires.world.now_s, frame_id, data)

    def close(self) -> None:
        self.lose(f"{self.place}: the bus was closed")

    def carry(self, frames: Sequence[Any]) -> None:
        """Frames on their way: the process reads them when it runs."""
        self.process.post(lambda: self._read(frames))

    def lose(self, reason: str) -> None:
        """The adapter is pulled."""
        self._open = False
        listening, self._listening = self._listening, []
        for listener in listening:
            self.process.post(lambda lost=listener.lost: lost(reason))

    def _read(self, frames: Sequence[Any]) -> None:
        read_s = self.process.computer.now_s()
        errors = sum(frame.error for frame in frames)
        for listener in tuple(self._listening):
            mine = [
                Frame(frame.can_id, frame.data, read_s, frame.time_us * 1e-6)
                for frame in frames
                if frame.can_id == listener.frame_id and not frame.error
            ]
            if mine:
                self._wires.read_s.setdefault(listener.frame_id, []).append(self.process.computer.true_s)
            if mine or errors:
                listener.handle(listener.decode(mine, 0, errors))

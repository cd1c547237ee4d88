"""A CAN adapter is opened once and read for all, slcan in one go, not byte by byte. Nothing is lost or made up."""

from __future__ import annotations

import contextlib
import os
import pty
import queue
import struct
import tty
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import serial

from stimrig.rig.adapters import can_bus
from stimrig.rig.adapters.can_bus import CanBus, ReadAhead
from stimrig.rig.clock import MonotonicClock
from stimrig.rig.devices import can_angle_sensor, can_load_cell
from stimrig.rig.devices.can_angle_sensor import CanAngleSensor
from stimrig.rig.devices.can_load_cell import CanLoadCell
from stimrig.rig.errors import DeviceError
from tests.simulator.virtual_time import VirtualMachine

FRAMES = 40  # of 22 bytes: they fit into the buffer of a pseudo-terminal
PATIENCE_S = 30.0


class CountingPort:
    """A port in memory that counts how often it is asked."""

    def __init__(self, data: bytes) -> None:
        self.data, self.asked = data, 0

    @property
    def in_waiting(self) -> int:
        return len(self.data)

    def read(self, size: int = 1) -> bytes:
        self.asked += 1
        part, self.data = self.data[:size], self.data[size:]
        return part


class Adapters(VirtualMachine):
    """A machine with real adapters. What their threads post is done while the test waits for something."""

    def __init__(self) -> None:
        super().__init__()
        self._posted: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.lost: list[str] = []

    def open_bus(self, arguments: dict[str, Any], name: str) -> CanBus:
        return CanBus(arguments, name, MonotonicClock(), self._posted.put)

    def shared_bus(self, arguments: dict[str, Any], name: str) -> CanBus | None:
        return CanBus.find(arguments, name)

    def until(self, true: Callable[[], object]) -> None:
        while not true():
            self._posted.get(timeout=PATIENCE_S)()


class Opened:
    """A device of such a machine, and what came from it."""

    def __init__(self, machine: Adapters, device: Any) -> None:
        self.machine, self.device, self._blocks = machine, device, list[np.ndarray]()
        self.open()

    def open(self) -> None:
        self.machine.run(self.device.open(lambda b: self._blocks.append(b.samples), self.machine.lost.append))

    def close(self) -> None:
        self.machine.run(self.device.close())

    def samples(self, n: int) -> np.ndarray:
        """Wait for so many; no more may have come."""
        self.machine.until(lambda: sum(map(len, self._blocks)) >= n)
        found, self._blocks[:] = np.concatenate(self._blocks), []
        assert len(found) == n
        return found


@pytest.fixture
def machine() -> Iterator[Adapters]:
    yield Adapters()
    assert not can_bus._open, "a test left an adapter open"


@pytest.fixture
def line() -> Iterator[tuple[int, dict[str, Any]]]:
    """Our end of an adapter that only one may open, and how the rig file calls it."""
    ours, theirs = pty.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    yield ours, {"interface": "slcan", "channel": os.ttyname(theirs)}
    os.close(theirs)
    with contextlib.suppress(OSError):  # pulled out by the test
        os.close(ours)


def cell_of(machine: Adapters, bus: dict[str, Any], **more: Any) -> Opened:
    return Opened(machine, CanLoadCell(can_load_cell.Settings(device="can_load_cell", bus=bus, **more), machine))


def sensor_of(machine: Adapters, bus: dict[str, Any]) -> Opened:
    return Opened(machine, CanAngleSensor(can_angle_sensor.Settings(device="can_angle_sensor", bus=bus), machine))


def slcan(frame_id: int, data: bytes) -> bytes:
    return f"t{frame_id:03X}{len(data)}".encode() + data.hex().encode() + b"\r"


def torque(i: int) -> bytes:
    return slcan(0x181, struct.pack("<fHBB", 0.5 * i, i, 0, 0))


def angle(i: int) -> bytes:
    return slcan(0x182, struct.pack("<fHBB", 1.5 * i, i, 0, 0))


def test_what_waits_is_asked_for_once_and_what_comes_later_after_it():
    port = CountingPort(b"t1818" * 200)
    ahead = ReadAhead(port)
    assert b"".join(ahead.read(1) for _ in range(1000)) == b"t1818" * 200
    assert (port.asked, ahead.in_waiting) == (1, 0)
    port.data = b"abc"
    assert ahead.read(2) == b"ab"
    port.data = b"de"
    assert ahead.in_waiting == 1
    assert [ahead.read(5), ahead.read(5), ahead.read(5)] == [b"c", b"de", b""]


def test_the_ports_write_timeout_is_the_ports(line: tuple[int, dict[str, Any]]):
    port = serial.Serial(line[1]["channel"])
    ReadAhead(port).write_timeout = 0.5
    assert port.write_timeout == 0.5


def test_a_cell_on_slcan_gives_every_frame_and_sends_its_own(machine: Adapters, line: tuple[int, dict[str, Any]]):
    ours, bus = line
    cell = cell_of(machine, bus, start_frames=["000#0100"])
    said = b""
    while len(said) < len(opened := b"O\rt00020100\r"):
        said += os.read(ours, 100)
    assert said == opened
    of_another = b"T000001818" + b"00" * 8 + b"\r"  # the same number in 29 bits
    os.write(ours, of_another.join(map(torque, range(FRAMES))))
    samples = cell.samples(FRAMES)
    assert samples["counter"].tolist() == list(range(FRAMES))
    assert samples["torque_nm"].tolist() == [0.5 * i for i in range(FRAMES)]
    cell.close()


def test_an_adapter_that_can_be_opened_once_is_shared(machine: Adapters, line: tuple[int, dict[str, Any]]):
    ours, bus = line
    cell, sensor = cell_of(machine, bus), sensor_of(machine, bus)
    assert sensor.device.on_the_cells_bus
    os.write(ours, b"".join(torque(2 * i) + angle(i) + torque(2 * i + 1) for i in range(20)))
    torques, angles = cell.samples(40), sensor.samples(20)
    assert torques["counter"].tolist() == list(range(40)) and angles["counter"].tolist() == list(range(20))
    assert angles["raw"].tolist() == [1.5 * i for i in range(20)]
    after = np.searchsorted(torques["host_time_s"], angles["host_time_s"])  # the order of the frames is kept
    assert after.tolist() == [2 * i + 1 for i in range(20)]
    sensor.close()
    os.write(ours, torque(40) + angle(20) + torque(41))
    cell.samples(2)  # the cell goes on alone
    assert machine.lost == []
    cell.close()


def test_with_the_cells_bus_the_sensor_is_gone_and_comes_back_with_it(
    machine: Adapters, line: tuple[int, dict[str, Any]]
):
    ours, bus = line
    cell, sensor = cell_of(machine, bus), sensor_of(machine, bus)
    cell.close()
    machine.until(lambda: len(machine.lost) == 2)  # the cell's own receiver is closing, and does not hear it
    assert machine.lost == [f"load cell on slcan {bus['channel']}: the bus was closed"] * 2
    sensor.close()
    cell.open()
    sensor.open()
    os.write(ours, angle(1))
    assert sensor.samples(1)["raw"].tolist() == [1.5]
    sensor.close()
    cell.close()


def test_an_adapter_that_is_pulled_out_is_told(machine: Adapters, line: tuple[int, dict[str, Any]]):
    cell, sensor = cell_of(machine, line[1]), sensor_of(machine, line[1])
    os.close(line[0])
    machine.until(lambda: len(machine.lost) == 2)
    assert all("the bus was lost" in reason for reason in machine.lost)
    sensor.close()
    cell.close()
    assert len(machine.lost) == 2


def test_an_adapter_of_its_own_is_the_sensors(machine: Adapters):
    sensor = sensor_of(machine, {"interface": "virtual", "channel": "own"})
    assert not sensor.device.on_the_cells_bus
    sensor.close()


def test_one_adapter_cannot_have_two_sets_of_arguments(machine: Adapters):
    bus = {"interface": "virtual", "channel": "two", "bitrate": 500_000}
    cell = cell_of(machine, bus)
    with pytest.raises(DeviceError, match=r"angle_sensor.bus: virtual two is already open with other arguments"):
        sensor_of(machine, {**bus, "bitrate": 250_000})
    cell.close()


def test_a_port_that_is_no_serial_line_is_left_as_it_is(machine: Adapters):
    """A socket says only whether anything waits, not how much."""
    cell = cell_of(machine, {"interface": "slcan", "channel": "loop://"})
    assert not isinstance(cell.device._bus.can.serialPortOrig, ReadAhead)
    cell.close()


def test_a_cell_whose_start_frames_are_not_sent_is_refused_and_not_lost_as_well(
    machine: Adapters, monkeypatch: pytest.MonkeyPatch
):
    def refuse(*_: object) -> None:
        raise DeviceError("not sent")

    monkeypatch.setattr(CanBus, "send", refuse)
    with pytest.raises(DeviceError, match="not sent"):
        cell_of(machine, {"interface": "virtual", "channel": "deaf"}, start_frames=["000#0100"])
    assert not can_bus._open
    while not machine._posted.empty():
        machine._posted.get()()
    assert machine.lost == []

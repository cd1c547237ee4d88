"""Text frames of an slcan adapter are read in one go, not byte by byte, and nothing is lost or made up."""

from __future__ import annotations

import contextlib
import os
import pty
import struct
import tty
from collections.abc import Iterator

import numpy as np
import pytest
import serial

from rig.clock import MonotonicClock
from rig.devices.can_load_cell import CanLoadCell, Settings
from rig.errors import DeviceError
from rig.wire.read_ahead import ReadAhead

FRAMES = 40  # of 22 bytes: they fit into the buffer of a pseudo-terminal


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


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    ours, theirs = pty.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    yield ours, os.ttyname(theirs)
    os.close(theirs)
    with contextlib.suppress(OSError):  # pulled out by the test
        os.close(ours)


def frame(torque_nm: float, counter: int) -> bytes:
    return b"t1818" + struct.pack("<fHBB", torque_nm, counter, 0, 0).hex().encode() + b"\r"


def test_what_waits_is_asked_for_once():
    port = CountingPort(b"t1818" * 200)
    ahead = ReadAhead(port)
    assert b"".join(ahead.read(1) for _ in range(1000)) == b"t1818" * 200
    assert port.asked == 1
    assert ahead.in_waiting == 0


def test_bytes_that_come_later_are_read_after_the_first_ones():
    port = CountingPort(b"abc")
    ahead = ReadAhead(port)
    assert ahead.read(2) == b"ab"
    port.data = b"de"
    assert ahead.in_waiting == 1
    assert [ahead.read(5), ahead.read(5), ahead.read(5)] == [b"c", b"de", b""]


def test_the_ports_write_timeout_is_the_ports(line: tuple[int, str]):
    port = serial.Serial(line[1])
    ReadAhead(port).write_timeout = 0.5
    assert port.write_timeout == 0.5


def test_a_cell_on_slcan_gives_every_frame_and_sends_its_own(line: tuple[int, str]):
    ours, path = line
    bus = {"interface": "slcan", "channel": path}
    cell = CanLoadCell(Settings(device="can_load_cell", bus=bus, start_frames=["000#0100"]), MonotonicClock())
    cell.open()
    said = b""
    while len(said) < len(opened := b"O\rt00020100\r"):
        said += os.read(ours, 100)
    assert said == opened
    os.write(ours, b"".join(frame(0.25 * i, i) for i in range(FRAMES)))
    samples: list[np.void] = []
    while len(samples) < FRAMES:
        samples += list(cell.read(0.05).samples)
    assert [s["counter"] for s in samples] == list(range(FRAMES))
    assert [s["torque_nm"] for s in samples] == [0.25 * i for i in range(FRAMES)]
    cell.close()


def test_a_port_that_is_no_serial_line_is_left_as_it_is():
    """A socket says only whether anything waits, not how much."""
    bus = {"interface": "slcan", "channel": "loop://"}
    cell = CanLoadCell(Settings(device="can_load_cell", bus=bus), MonotonicClock())
    cell.open()
    assert not isinstance(cell._bus.can.serialPortOrig, ReadAhead)  # pyright: ignore
    cell.close()


def test_an_adapter_that_is_pulled_out_is_told(line: tuple[int, str]):
    bus = {"interface": "slcan", "channel": line[1]}
    cell = CanLoadCell(Settings(device="can_load_cell", bus=bus), MonotonicClock())
    cell.open()
    os.close(line[0])
    with pytest.raises(DeviceError, match="the bus was lost"):
        cell.read(0.05)
    cell.close()

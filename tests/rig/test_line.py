"""The serial port: what it reads, what it tells, and what it refuses to drive."""

from __future__ import annotations

import contextlib
import os
import queue
import tty
from collections.abc import Callable, Iterator

import pytest

from stimrig.rig.adapters import serial_port
from stimrig.rig.adapters.serial_port import SerialPort
from stimrig.rig.clock import MonotonicClock
from stimrig.rig.errors import DeviceError

PATIENCE_S = 30.0


class Line:
    def __init__(self) -> None:
        self.ours, theirs = os.openpty()
        tty.setraw(theirs)
        self.path, self._theirs = os.ttyname(theirs), theirs
        self._posted: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.heard, self.times_s, self.lost = b"", list[float](), list[str]()

    def port(self, speed: float = 1.0) -> SerialPort:
        return SerialPort(self.path, MonotonicClock(speed), self._posted.put)

    def open(self, speed: float = 1.0) -> SerialPort:
        port = self.port(speed)
        port.open(self._hear, self.lost.append)
        return port

    def until(self, true: Callable[[], object]) -> None:
        """Do what the port's thread posts until something is true."""
        while not true():
            self._posted.get(timeout=PATIENCE_S)()

    def hang_up(self) -> None:
        os.close(self.ours)
        self.ours = -1

    def close(self) -> None:
        os.close(self._theirs)
        with contextlib.suppress(OSError):
            os.close(self.ours)

    def _hear(self, data: bytes, time_s: float) -> None:
        self.heard += data
        self.times_s.append(time_s)


@pytest.fixture
def line() -> Iterator[Line]:
    made = Line()
    yield made
    made.close()


def test_bytes_come_with_their_time_and_go_out_at_once(line: Line):
    port = line.open()
    before_s = MonotonicClock().now_s()
    os.write(line.ours, b"abc")
    line.until(lambda: line.heard == b"abc")
    assert before_s <= line.times_s[0] <= line.times_s[-1] <= MonotonicClock().now_s()
    assert port.write(b"defg") == 4
    assert os.read(line.ours, 10) == b"defg"
    port.close()
    assert line.lost == []
    with pytest.raises(OSError, match="not opened"):
        port.write(b"x")


def test_a_line_that_is_gone_is_told_once(line: Line):
    port = line.open()
    line.hang_up()
    line.until(lambda: line.lost)
    assert line.lost[0].startswith("the connection was lost (")
    port.discard()
    port.close()
    assert len(line.lost) == 1


def test_a_line_that_takes_nothing_holds_up_nobody_and_forgets_what_waits(line: Line):
    port, taken = line.open(), 0
    with contextlib.suppress(BlockingIOError):
        while (n := port.write(b"x" * 1000)) == 1000:
            taken += n
    assert taken > 0
    port.discard()
    assert port.write(b"y") == 1
    arrived = b""
    while not arrived.endswith(b"y"):
        arrived += os.read(line.ours, 100_000)
    assert len(arrived) < taken
    port.close()


def test_a_port_that_is_missing_or_in_use_is_told(line: Line):
    port = line.open()
    with pytest.raises(DeviceError, match=rf"{line.path} cannot be opened .*is another program using it\?"):
        line.open()
    port.close()
    line.open().close()
    line.path = "/dev/pts/gone"
    with pytest.raises(DeviceError, match="/dev/pts/gone is missing; plug in the stimulator or correct the port"):
        line.open()


def test_a_clock_that_runs_fast_drives_an_emulator_only(line: Line, monkeypatch: pytest.MonkeyPatch):
    """Whatever the rig was told of its port: the port itself is looked at, at each opening."""
    line.open(50.0).close()
    monkeypatch.setattr(serial_port, "PSEUDO_TERMINALS", "/nowhere/")
    with pytest.raises(DeviceError, match="real device"):
        line.open(50.0)
    line.open(1.0).close()

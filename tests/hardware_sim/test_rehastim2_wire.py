"""The RehaStim 2 over its pseudo-terminal: connection, the host's silence and death, errors, faults."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
import serial

from hardware_sim.stimulators.framing import Packet
from hardware_sim.stimulators.sciencemode2 import Decoder, encode
from tests.hardware_sim.emulated import Emulated, emulated, wait_for

pytestmark = pytest.mark.wire
INIT_LIST = bytes.fromhex("00 01 00 0d 0030 00")
PULSE = bytes.fromhex("00 00fa 14")
EMERGENCY, ELECTRODE, MODULE = b"\xff", b"\xfe", b"\xfd"


class Host:
    """A bare host on the line."""

    def __init__(self, rig: Emulated) -> None:
        self.rig = rig
        self.line = serial.Serial(
            rig.ask(cmd="state")["stimulator"], 460_800, parity=serial.PARITY_EVEN, timeout=0.02, exclusive=True
        )
        self._decoder = Decoder()
        self._packets: list[Packet] = []

    def forget(self) -> None:
        self.line.reset_input_buffer()
        self._decoder = Decoder()
        self._packets.clear()

    def send(self, command: int, data: bytes = b"", number: int = 5) -> None:
        self.line.write(encode(Packet(number, command, data)))

    def wait(self, command: int, seconds: float = 0.2) -> Packet | None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            while self._packets:
                packet = self._packets.pop(0)
                if packet.command == command:
                    return packet
            self._packets += self._decoder.feed(self.line.read(self.line.in_waiting or 1), 0.0)
        return None

    def result(self, command: int, data: bytes = b"") -> int | None:
        self.send(command, data)
        ack = self.wait(command + 1)
        return None if ack is None else int.from_bytes(ack.data[:1], "big", signed=True)

    def connect(self) -> None:
        init = self.wait(1, 1.0)
        assert init is not None
        self.send(2, b"\x00", init.number)
        assert self.result(34) == 0

    def start(self) -> None:
        assert self.result(30, INIT_LIST) == 0
        assert self.result(32, PULSE) == 0

    def pulses(self) -> list[dict]:
        return self.rig.ask(cmd="pulses")["pulses"]


@pytest.fixture(scope="module")
def rig() -> Iterator[Emulated]:
    with emulated("--stimulator", "rehastim2") as running:
        yield running


@pytest.fixture
def host(rig: Emulated) -> Iterator[Host]:
    made = Host(rig)
    if rig.ask(cmd="state")["mode"] == "none":
        made.connect()
    assert made.result(34) == 0
    yield made
    made.line.close()


def test_init_after_init_and_no_backlog_for_a_late_client() -> None:
    with emulated("--stimulator", "rehastim2", "--speed", "100") as rig:
        time.sleep(0.5)  # a hundred Inits of the device's time
        line = serial.Serial(rig.ready["stimulator"], 460_800, parity="E", timeout=0)
        time.sleep(0.05)
        assert len(line.read(4096)) <= 2 * 12
        line.close()


def test_a_killed_host_is_outlived_by_at_most_1200_ms(rig: Emulated) -> None:
    """The worst case of ScienceMode 2's channel list: the host dies between two commands."""
    rig.ask(cmd="fault", name="device_reset", for_s=0)
    before = len(rig.ask(cmd="pulses")["pulses"])
    script = (
        "import sys, time\n"
        "from tests.hardware_sim.test_rehastim2_wire import Host, PULSE\n"
        "class Rig:\n"
        "    def ask(self, **_): return {'stimulator': sys.argv[1]}\n"
        "host = Host(Rig()); host.connect(); host.start()\n"
        "while True:\n"
        "    assert host.result(32, PULSE) == 0; print(time.monotonic(), flush=True); time.sleep(0.02)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script, rig.ready["stimulator"]], stdout=subprocess.PIPE)
    assert process.stdout is not None
    for _ in range(10):
        assert process.stdout.readline()
    os.kill(process.pid, signal.SIGKILL)
    rig.ask(cmd="state")  # what was sent before has come by now
    killed_s = time.monotonic()
    process.wait()
    process.stdout.close()
    wait_for(lambda: rig.ask(cmd="state")["mode"] == "none", seconds=2)
    played = rig.ask(cmd="pulses")["pulses"][before:]
    after = [pulse for pulse in played if pulse["monotonic_s"] > killed_s]
    assert len(after) >= 45  # it did go on: this is the bound that the safety case must state
    assert played[-1]["monotonic_s"] - killed_s <= 1.2

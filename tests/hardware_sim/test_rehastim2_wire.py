"""The RehaStim 2 over its pseudo-terminal: the host's silence and death."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest
import serial

from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode2
from tests.hardware_sim.emulated import emulated, wait_for

pytestmark = pytest.mark.wire


def pulse_for_ever(path: str) -> None:
    """Connect, start a channel list, and tell each ack of its pulses."""
    line, decoder, packets = serial.Serial(path, 460_800, parity=serial.PARITY_EVEN), ScienceMode2(), list[Packet]()

    def wait(command: int) -> Packet:
        while not [packet for packet in packets if packet.command == command]:
            packets.extend(decoder.feed(line.read(line.in_waiting or 1), 0.0))
        found = next(packet for packet in packets if packet.command == command)
        packets.clear()
        return found

    line.write(ScienceMode2.encode(Packet(wait(1).number, 2, b"\x00")))
    line.write(ScienceMode2.encode(Packet(5, 30, bytes.fromhex("00 01 00 0d 0030 00"))))
    assert wait(31).data == b"\x00"
    while True:
        line.write(ScienceMode2.encode(Packet(5, 32, bytes.fromhex("00 00fa 14"))))
        assert wait(33).data == b"\x00"
        print(time.monotonic(), flush=True)
        time.sleep(0.02)


@pytest.mark.campaign
def test_init_after_init_and_no_backlog_for_a_late_client() -> None:
    with emulated("--stimulator", "rehastim2", "--speed", "100") as rig:
        time.sleep(0.5)  # a hundred Inits of the device's time
        line = serial.Serial(rig.ready["stimulator"], 460_800, parity="E", timeout=0)
        time.sleep(0.05)
        assert len(line.read(4096)) <= 2 * 12
        line.close()


@pytest.mark.campaign
def test_a_killed_host_is_outlived_by_at_most_1200_ms() -> None:
    """The worst case of ScienceMode 2's channel list: the host dies between two commands."""
    script = f"import sys; from {__name__} import pulse_for_ever; pulse_for_ever(sys.argv[1])"
    with emulated("--stimulator", "rehastim2") as rig:
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
        pulses = rig.ask(cmd="pulses")["pulses"]
    after = [pulse for pulse in pulses if pulse["monotonic_s"] > killed_s]
    assert len(after) >= 45  # it did go on: this is the bound that the safety case must state
    assert pulses[-1]["monotonic_s"] - killed_s <= 1.2

"""Each fault as the host sees it, over the wire and the control line."""

from __future__ import annotations

import contextlib
import math
import struct
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import pytest
import serial

from hardware_sim.faults.registry import library
from hardware_sim.stimulators.framing import Packet
from hardware_sim.stimulators.sciencemode4 import Decoder, encode
from tests.hardware_sim.bench_board import LL_CONFIG, LL_INIT, biphasic, config
from tests.hardware_sim.emulated import Emulated, emulated, wait_for

pytestmark = pytest.mark.wire
LAYOUT = struct.Struct("<fHBB")
PULSE = config(*biphasic(250, 20))
GENERAL_ERROR = 66


def values_of(messages: list[can.Message]) -> list[tuple[float, int, int, int]]:
    return [LAYOUT.unpack(message.data) for message in messages if not message.is_error_frame]


class Host:
    """A bare host: bytes out, packets and samples in."""

    def __init__(self, rig: Emulated, bus: can.BusABC) -> None:
        self.rig, self.bus = rig, bus
        self.plug()

    def plug(self) -> None:
        self.line = serial.Serial(self.rig.ask(cmd="state")["stimulator"], 3_000_000, timeout=0.25)
        self._decoder = Decoder()

    def ask(self, command: int, data: bytes = b"", wait_s: float = 0.25) -> list[Packet]:
        self.line.write(encode(Packet(1, command, data)))
        return self.read(wait_s)

    def read(self, wait_s: float) -> list[Packet]:
        packets, end_s = [], time.monotonic() + wait_s
        while not packets and time.monotonic() < end_s:
            packets += self._decoder.feed(self.line.read(self.line.in_waiting or 1), 0.0)
        return packets

    def result(self, command: int, data: bytes = b"") -> int:
        (packet, *_) = self.ask(command, data, wait_s=20.0)
        return packet.data[0]

    def settle(self) -> None:
        """Let go of the frames that were on their way when the fault came."""
        time.sleep(0.02)
        while self.bus.recv(0.0) is not None:
            pass

    def tail(self, seconds: float = 0.2) -> list[can.Message]:
        messages, end_s = [], time.monotonic() + seconds
        while time.monotonic() < end_s:
            message = self.bus.recv(0.05)
            if message is not None:
                messages.append(message)
        return messages

    def samples(self, number: int = 300) -> list[tuple[float, int, int, int]]:
        """The next samples, so that no check on all of them is made on none."""
        self.settle()
        found, end_s = [], time.monotonic() + 20
        while len(found) < number:
            assert time.monotonic() < end_s, f"{len(found)} of {number} samples came"
            found += values_of(self.tail(0.05))
        return found

    def samples_or_none(self) -> list[tuple[float, int, int, int]]:
        self.settle()
        return values_of(self.tail(0.3))

    def steps(self, number: int = 300) -> list[int]:
        return [(after[1] - before[1]) & 0xFFFF for before, after in pairwise(self.samples(number))]


@pytest.fixture(scope="module")
def shared() -> Iterator[Host]:
    with emulated("--noise-seed", "1", "--torque-offset-nm", "5") as rig, can.Bus(**rig.ready["can"]) as bus:
        host = Host(rig, bus)
        yield host
        host.line.close()


@pytest.fixture
def host(shared: Host) -> Host:
    assert shared.result(LL_INIT, b"\x00") == 0
    return shared


@contextlib.contextmanager
def broken(host: Host, name: str, **settings: Any) -> Iterator[dict[str, Any]]:
    answer = host.rig.ask(cmd="fault", name=name, on=True, **settings)
    assert answer["ok"], answer
    try:
        yield answer
    finally:
        assert host.rig.ask(cmd="fault", name=name, on=False)["ok"]


def test_no_ack_but_the_pulse_is_fired(host: Host) -> None:
    before = host.rig.ask(cmd="state")["pulses_delivered"]
    with broken(host, "no_ack"):
        assert host.ask(LL_CONFIG, PULSE) == []
    assert host.rig.ask(cmd="state")["pulses_delivered"] == before + 1
    assert host.result(LL_CONFIG, PULSE) == 0


def test_late_ack(host: Host) -> None:
    with broken(host, "late_ack", delay_s=0.15):
        start_s = time.monotonic()
        assert host.result(LL_CONFIG, PULSE) == 0
        assert time.monotonic() - start_s > 0.15


def delivered(host: Host) -> int:
    return host.rig.ask(cmd="state")["pulses_delivered"]


def test_a_stalled_line_holds_and_lets_go_of_what_it_held(host: Host) -> None:
    before = delivered(host)
    with broken(host, "line_stalled", to_host=False):
        assert host.ask(LL_CONFIG, PULSE, wait_s=0.1) == []
        assert delivered(host) == before
    assert host.read(0.25) != []
    assert delivered(host) == before + 1
    with broken(host, "line_stalled", to_device=False):
        assert host.ask(LL_CONFIG, PULSE, wait_s=0.1) == []
        assert delivered(host) == before + 2
    assert host.read(0.25) != []
    assert host.result(LL_CONFIG, PULSE) == 0


def test_a_doubled_command_is_done_twice(host: Host) -> None:
    before = delivered(host)
    with broken(host, "frames_doubled"):
        host.ask(LL_CONFIG, PULSE)
        wait_for(lambda: delivered(host) == before + 2)
    host.read(0.05)


def test_corrupt_both_ways(host: Host) -> None:
    with broken(host, "corrupt_answers"):
        assert host.ask(LL_CONFIG, PULSE, wait_s=0.1) == []
    host.line.reset_input_buffer()
    host._decoder = Decoder()
    before = host.rig.ask(cmd="state")
    with broken(host, "corrupt_commands"):
        answers = [packet for _ in range(6) for packet in host.ask(LL_CONFIG, PULSE, wait_s=0.15)]
    assert {packet.command for packet in answers} == {GENERAL_ERROR}
    time.sleep(0.15)
    host.ask(62)
    after = host.rig.ask(cmd="state")
    assert after["pulses_delivered"] == before["pulses_delivered"]


def test_electrode_high_voltage_and_reset(host: Host) -> None:
    with broken(host, "electrode_error"):
        assert host.result(LL_CONFIG, PULSE) == 10
    with broken(host, "emergency_switch"):
        assert host.result(LL_CONFIG, PULSE) == 10
    with broken(host, "high_voltage_error"):
        assert host.result(LL_CONFIG, PULSE) == 8
    assert host.result(LL_CONFIG, PULSE) == 0
    with broken(host, "device_reset"):
        assert host.result(LL_CONFIG, PULSE) == 7
    with broken(host, "device_reset", mid_frame=True):
        assert host.line.read(4) == bytes.fromhex("f0815581")
        assert host.result(LL_CONFIG, PULSE) == 7


def test_unplugged_mid_frame_and_back(host: Host) -> None:
    link = Path(host.rig.ready["stimulator_link"])
    with broken(host, "stimulator_unplugged"):
        time.sleep(0.02)
        with pytest.raises((OSError, serial.SerialException)):
            for _ in range(10):
                host.line.write(encode(Packet(1, LL_CONFIG, PULSE)))
                host.line.read(1)
        assert host.rig.ask(cmd="state")["stimulator"] is None
        assert not link.exists()
    host.line.close()
    assert link.is_char_device()
    host.plug()
    assert host.result(LL_CONFIG, PULSE) == 0  # it had its own battery


def test_silent(host: Host) -> None:
    with broken(host, "cell_silent"):
        assert host.samples_or_none() == []
    assert set(host.steps()) == {1}


def test_dropped_duplicated_out_of_order(host: Host) -> None:
    with broken(host, "frames_dropped", probability=0.1):
        steps = host.steps(700)
        assert min(steps) == 1
        assert 0.04 < 1 - len(steps) / sum(steps) < 0.18
    with broken(host, "frames_duplicated", probability=0.1):
        assert set(host.steps()) == {0, 1}
    with broken(host, "frames_out_of_order", probability=0.1):
        assert {0xFFFF, 2} <= set(host.steps())


def test_corrupt_frames(host: Host) -> None:
    with broken(host, "frames_corrupt", probability=1.0):
        assert set(host.steps()) != {1}


def test_values(host: Host) -> None:
    with broken(host, "torque_stuck"):
        samples = host.samples()
        assert len({torque for torque, *_ in samples}) == 1
        assert len({counter for _, counter, *_ in samples}) == len(samples)
    with broken(host, "torque_nan"):
        assert all(math.isnan(torque) for torque, *_ in host.samples())
    with broken(host, "torque_sign_flipped"):
        assert all(torque < -3 for torque, *_ in host.samples())
    with broken(host, "torque_saturated", limit_nm=3.0):
        assert {torque for torque, *_ in host.samples()} == {3.0}
    with broken(host, "torque_step", step_nm=40.0):
        assert all(torque > 40 for torque, *_ in host.samples())
    assert all(3 < torque < 12 for torque, *_ in host.samples())


def test_bus_errors(host: Host) -> None:
    with broken(host, "error_frames", probability=0.5):
        host.settle()
        messages = [host.bus.recv(10.0) for _ in range(600)]
        errors = [m for m in messages if m is None or m.is_error_frame]
        assert None not in messages
        assert 0.2 < len(errors) / len(messages) < 0.45
    host.settle()
    with broken(host, "bus_off"):
        errors = [m for m in host.tail() if m.is_error_frame]
        assert [m.arbitration_id for m in errors] == [0x40]
        assert host.samples_or_none() == []


def test_counter_jump(host: Host) -> None:
    while host.bus.recv(0.0) is not None:
        pass
    steps: list[int] = []
    before = counter(host)  # before the fault: an emulator that wakes up may jump first and send then
    with broken(host, "counter_jump", step=1000):
        while len(steps) < 200:
            after = counter(host)
            steps.append((after - before) & 0xFFFF)
            before = after
    assert sorted(steps) == [1] * 199 + [1001]


def counter(host: Host) -> int:
    message = host.bus.recv(5.0)
    assert message is not None
    return LAYOUT.unpack(message.data)[1]


def test_rate_off(host: Host) -> None:
    with broken(host, "rate_off", percent=5.0):
        before = host.rig.ask(cmd="state")
        time.sleep(0.5)
        after = host.rig.ask(cmd="state")
    rate_hz = (after["samples"] - before["samples"]) / (after["time_s"] - before["time_s"])
    assert rate_hz == pytest.approx(1680, rel=0.01)


def test_for_s_ends_by_itself(host: Host) -> None:
    answer = host.rig.ask(cmd="fault", name="cell_silent", for_s=0.1)
    assert answer["active"] == ["cell_silent"]
    wait_for(lambda: host.rig.ask(cmd="state")["faults"] == [], seconds=10)


def test_cell_unplugged_and_back() -> None:
    for transport in ("socketcand", "slcan"):
        with emulated("--load-cell", transport) as rig:
            bus = can.Bus(**rig.ready["can"])
            assert bus.recv(10.0) is not None
            assert rig.ask(cmd="fault", name="cell_unplugged")["ok"]
            with contextlib.suppress(Exception):  # python-can's own ways to fail here differ by interface
                bus.shutdown()
            assert rig.ask(cmd="fault", name="cell_unplugged", on=False)["ok"]
            with can.Bus(**rig.ask(cmd="state")["can"]) as again:
                assert again.recv(10.0) is not None


def test_faults_from_the_start() -> None:
    with emulated("--fault", "torque_saturated,limit_nm=0.01", "--fault", "no_ack") as rig:
        assert rig.ask(cmd="state")["faults"] == ["no_ack", "torque_saturated"]


def test_the_library_is_listed_and_every_fault_can_be_switched(host: Host) -> None:
    listed = host.rig.ask(cmd="faults")["faults"]
    assert set(listed) == set(library()) >= {"no_ack", "cell_silent"}
    assert "" not in {entry["what"] for entry in listed.values()}
    for name in {name for name in listed if not name.startswith("angle_")} - {"stimulator_unplugged", "cell_unplugged"}:
        with broken(host, name) as answer:
            assert answer["active"] == [name]


@pytest.mark.parametrize(
    ("request_", "told"),
    [
        ({"cmd": "dance"}, "unknown command"),
        ({"cmd": "fault", "name": "dance"}, "unknown fault"),
        ({"cmd": "fault", "name": "late_ack", "delay_s": "long"}, "must be like"),
        ({"cmd": "fault", "name": "late_ack", "delay": 1}, "no setting"),
        ({"cmd": "fault", "name": "late_ack", "for_s": -1}, "for_s"),
        ({}, "cmd"),
    ],
)
def test_the_control_line_tells_what_is_wrong(host: Host, request_: dict[str, Any], told: str) -> None:
    answer = host.rig.ask(**request_)
    assert answer["ok"] is False
    assert told in answer["error"]


def test_pulses_carry_the_hosts_monotonic_time(host: Host) -> None:
    have = len(host.rig.ask(cmd="pulses")["pulses"])
    before_s = time.monotonic()
    assert host.result(LL_CONFIG, PULSE) == 0
    (pulse,) = host.rig.ask(cmd="pulses", since=have)["pulses"]
    assert before_s <= pulse["monotonic_s"] <= time.monotonic()
    assert (pulse["width_us"], pulse["current_ma"], pulse["balanced"]) == (250, 20, True)

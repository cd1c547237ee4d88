"""Each fault as the host sees it: in virtual time, and over the wire what needs a port or the control line."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
import serial

from stimrig.hardware_sim.faults import library
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode4
from tests.hardware_sim.bench_board import LL_CONFIG, LL_INIT, biphasic, config
from tests.hardware_sim.emulated import Emulated, emulated, wait_for
from tests.hardware_sim.virtual_host import VirtualHost

PULSE = config(*biphasic(250, 20))


@pytest.fixture
def host() -> VirtualHost:
    made = VirtualHost(noise_seed=1, torque_offset_nm=5.0)
    assert made.result(LL_INIT, b"\x00") == 0
    return made


@contextlib.contextmanager
def broken(host: VirtualHost, name: str, **settings: Any) -> Iterator[None]:
    host.devices.faults.on(name, settings)
    assert host.devices.faults.active() == [name]
    yield
    host.devices.faults.off(name)
    assert host.devices.faults.active() == []


def delivered(host: VirtualHost) -> int:
    return host.devices.electrodes.delivered_pulses


def test_no_ack_but_the_pulse_is_fired(host: VirtualHost) -> None:
    with broken(host, "no_ack"):
        assert host.ask(LL_CONFIG, PULSE) == []
    assert delivered(host) == 1
    assert host.result(LL_CONFIG, PULSE) == 0


def test_late_ack(host: VirtualHost) -> None:
    with broken(host, "late_ack", delay_s=0.15):
        sent_s = host.devices.timeline.now_s
        assert host.result(LL_CONFIG, PULSE) == 0
    assert host.answered_s == pytest.approx(sent_s + 0.15 + 600e-6)


def test_electrode_high_voltage_and_reset(host: VirtualHost) -> None:
    for name, result in (("electrode_error", 10), ("emergency_switch", 10), ("high_voltage_error", 8)):
        with broken(host, name):
            assert host.result(LL_CONFIG, PULSE) == result
    assert host.result(LL_CONFIG, PULSE) == 0
    with broken(host, "device_reset", mid_frame=True):
        assert host.devices.take_bytes() == [(host.devices.timeline.now_s, bytes.fromhex("f0815581"))]
        assert host.result(LL_CONFIG, PULSE) == 7


def test_silent_dropped_duplicated_out_of_order_corrupt(host: VirtualHost) -> None:
    with broken(host, "cell_silent"):
        assert host.samples() == []
    assert set(host.steps()) == {1}
    with broken(host, "frames_dropped", probability=0.1):
        steps = host.steps()
        assert min(steps) == 1
        assert 0.04 < 1 - len(steps) / sum(steps) < 0.18
    with broken(host, "frames_duplicated", probability=0.1):
        assert set(host.steps()) == {0, 1}
    with broken(host, "frames_out_of_order", probability=0.1):
        assert {0xFFFF, 2} <= set(host.steps())
    with broken(host, "frames_corrupt", probability=1.0):
        assert set(host.steps()) != {1}


def test_values(host: VirtualHost) -> None:
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


def test_bus_errors(host: VirtualHost) -> None:
    with broken(host, "error_frames", probability=0.5):
        errors = [frame for frame in host.frames() if frame.error]
        assert 0.4 < len(errors) / 800 < 0.6
    with broken(host, "bus_off"):
        assert [(frame.can_id, frame.error) for frame in host.frames()] == [(0x20000040, True)]


def test_counter_jump_and_rate_off(host: VirtualHost) -> None:
    before = host.samples()[-1]
    with broken(host, "counter_jump", step=1000):
        assert (host.samples()[0][1] - before[1]) & 0xFFFF == 1001
        assert set(host.steps()) == {1}
    with broken(host, "rate_off", percent=5.0):
        assert len(host.samples(1.0)) == pytest.approx(1680, abs=1)


def test_for_s_ends_by_itself(host: VirtualHost) -> None:
    host.devices.faults.on("cell_silent", {}, for_s=0.1)
    assert len(host.samples(0.5)) == pytest.approx(640, abs=1)
    assert host.devices.faults.active() == []


def test_every_fault_can_be_switched(host: VirtualHost) -> None:
    for name in library():
        if not name.startswith("angle_"):
            with broken(host, name):
                host.ask(LL_CONFIG, PULSE)


@pytest.fixture(scope="module")
def rig() -> Iterator[Emulated]:
    with emulated("--noise-seed", "1") as running:
        yield running


@pytest.mark.wire
def test_unplugged_mid_frame_and_back(rig: Emulated) -> None:
    link = Path(rig.ready["stimulator_link"])

    def initialised(port: str) -> bool:
        with serial.Serial(port, 3_000_000, timeout=20) as line:
            line.write(ScienceMode4.encode(Packet(1, LL_INIT, b"\x00")))
            return len(line.read(13)) == 13

    with serial.Serial(rig.ready["stimulator"], 3_000_000, timeout=0.25) as line:
        assert rig.ask(cmd="fault", name="stimulator_unplugged")["active"] == ["stimulator_unplugged"]
        time.sleep(0.02)
        with pytest.raises((OSError, serial.SerialException)):
            for _ in range(10):
                line.write(ScienceMode4.encode(Packet(1, LL_CONFIG, PULSE)))
                line.read(1)
        assert rig.ask(cmd="state")["stimulator"] is None
        assert not link.exists()
        assert rig.ask(cmd="fault", name="stimulator_unplugged", on=False)["ok"]
    assert link.is_char_device()
    assert initialised(rig.ask(cmd="state")["stimulator"])


@pytest.mark.wire
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


@pytest.mark.wire
@pytest.mark.parametrize(
    ("request_", "told"),
    [
        ({"cmd": "dance"}, "unknown command"),
        ({"cmd": "fault", "name": "dance"}, "unknown fault"),
        ({"cmd": "fault", "name": "late_ack", "delay_s": "long"}, "must be like"),
        ({"cmd": "fault", "name": "late_ack", "delay": 1}, "no setting"),
        ({"cmd": "fault", "name": "late_ack", "for_s": -1}, "for_s"),
        ({"cmd": "arm", "mode": "held"}, "this rig has no arm; start it with --arm"),
        ({}, "cmd"),
    ],
)
def test_the_control_line_tells_what_is_wrong(rig: Emulated, request_: dict[str, Any], told: str) -> None:
    answer = rig.ask(**request_)
    assert answer["ok"] is False
    assert told in answer["error"]


@pytest.mark.wire
def test_pulses_carry_the_hosts_monotonic_time(rig: Emulated) -> None:
    before_s = time.monotonic()
    with serial.Serial(rig.ask(cmd="state")["stimulator"], 3_000_000, timeout=20) as line:
        line.write(ScienceMode4.encode(Packet(1, LL_INIT, b"\x00")) + ScienceMode4.encode(Packet(2, LL_CONFIG, PULSE)))
        wait_for(lambda: len(rig.ask(cmd="pulses")["pulses"]) == 1)
    (pulse,) = rig.ask(cmd="pulses")["pulses"]
    assert before_s <= pulse["monotonic_s"] <= time.monotonic()
    assert (pulse["width_us"], pulse["current_ma"], pulse["balanced"]) == (250, 20, True)

"""Each fault as the host sees it: in virtual time, and over the wire what needs a port or the control line."""

from __future__ import annotations

import contextlib
import math
import struct
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
import serial

from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.faults import library
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode4
from tests.hardware_sim.emulated import Emulated, emulated, wait_for
from tests.hardware_sim.virtual_host import LAYOUT, LL_CONFIG, LL_INIT, VirtualHost, biphasic, config

PULSE = config(*biphasic(250, 20))
CELL, ANGLE = 0x181, 0x182
OF_THE_ANGLE = [name for name in library() if name.startswith("angle_")]
Row = tuple[float, int, int, int]


class Host(VirtualHost):
    """A cell that reads about 5 N·m, and an angle that rises by 5 degrees a second from 60 on and reads 10 more."""

    def __init__(self, **settings: Any) -> None:
        angle = {"angle_offset_deg": 10.0, "angle_noise_deg": 0.0, "angle_bits": 20}
        super().__init__("held", noise_seed=1, torque_offset_nm=5.0, **angle, **settings)
        self.devices.encoder._angle_deg = lambda time_s: 60.0 + 5.0 * time_s

    def rows(self, seconds: float, can_id: int = ANGLE) -> list[Row]:
        return [LAYOUT.unpack(frame.data) for frame in self.frames(seconds) if frame.can_id == can_id]


@pytest.fixture
def host() -> Host:
    made = Host()
    assert made.result(LL_INIT, b"\x00") == 0
    return made


@contextlib.contextmanager
def broken(host: VirtualHost, name: str, **settings: Any) -> Iterator[None]:
    host.devices.faults.on(name, settings)
    assert host.devices.faults.active() == [name]
    yield
    host.devices.faults.off(name)
    assert host.devices.faults.active() == []


def test_answers_that_are_lost_or_late_and_the_pulse_is_fired(host: Host) -> None:
    with broken(host, "no_ack"):
        assert host.answers(LL_CONFIG, PULSE) == []
    with broken(host, "late_ack", delay_s=0.15):
        sent_s = host.timeline.now_s
        assert host.result(LL_CONFIG, PULSE) == 0
    assert host.sent[-1][0] == pytest.approx(sent_s + 0.15 + 600e-6)
    assert len(host.pulses) == 2


def test_electrode_high_voltage_and_reset(host: Host) -> None:
    for name, result in (("electrode_error", 10), ("emergency_switch", 10), ("high_voltage_error", 8)):
        with broken(host, name):
            assert host.result(LL_CONFIG, PULSE) == result
    assert host.result(LL_CONFIG, PULSE) == 0
    with broken(host, "device_reset", mid_frame=True):
        assert host.devices.take_bytes() == [(host.timeline.now_s, bytes.fromhex("f0815581"))]
        assert host.result(LL_CONFIG, PULSE) == 7


def values(rows: list[Row]) -> np.ndarray:
    return np.array([row[0] for row in rows])


def steps(rows: list[Row]) -> set[int]:
    return {(after[1] - before[1]) & 0xFFFF for before, after in pairwise(rows)}


def near(value: float) -> Any:
    return pytest.approx(value, abs=0.1)


def jumps(rows: list[Row], _: Row) -> bool:
    """Of single readings."""
    off_deg = np.diff(values(rows))
    return set(np.round(off_deg / 15.0)) >= {-1.0, 0.0, 1.0} and 0.05 < np.mean(np.abs(off_deg) > 7.0) < 0.15


def turned(rows: list[Row], last: Row) -> bool:
    """From where it is: no jump gives it away."""
    slope_deg_s = np.polyfit(0.005 * np.arange(len(rows)), values(rows), 1)[0]
    return rows[0][0] == near(last[0]) and slope_deg_s == pytest.approx(-5.0, rel=0.01)


SHOWN: list[tuple[str, float, dict[str, Any], Callable[[list[Row], Row], Any]]] = [
    ("cell_silent", 0.5, {}, lambda rows, _: rows == []),
    ("frames_dropped", 0.5, {}, lambda rows, _: steps(rows) >= {1, 2} and 660 < len(rows) < 770),
    ("frames_duplicated", 0.5, {}, lambda rows, _: steps(rows) == {0, 1}),
    ("frames_out_of_order", 0.5, {}, lambda rows, _: steps(rows) >= {0xFFFF, 2}),
    ("frames_corrupt", 0.5, {"probability": 1.0}, lambda rows, _: steps(rows) != {1}),
    ("torque_stuck", 0.5, {}, lambda rows, _: len(set(values(rows))) == 1 and steps(rows) == {1}),
    ("torque_nan", 0.5, {}, lambda rows, _: np.isnan(values(rows)).all()),
    ("torque_sign_flipped", 0.5, {}, lambda rows, _: np.all(values(rows) < -3.0)),
    ("torque_saturated", 0.5, {"limit_nm": 3.0}, lambda rows, _: set(values(rows)) == {3.0}),
    ("torque_step", 0.5, {"step_nm": 40.0}, lambda rows, _: np.all(values(rows) > 40.0)),
    ("counter_jump", 0.5, {}, lambda rows, last: (rows[0][1] - last[1]) & 0xFFFF == 1001 and steps(rows) == {1}),
    ("rate_off", 1.0, {}, lambda rows, _: len(rows) == pytest.approx(1680, abs=1)),
    ("angle_stuck", 1.0, {}, lambda rows, _: len(set(values(rows))) == 1 and steps(rows) == {1}),
    ("angle_silent", 1.0, {}, lambda rows, _: rows == []),
    ("angle_jump", 5.0, {"step_deg": 15.0, "probability": 0.05}, jumps),
    ("angle_nan", 1.0, {"probability": 0.3}, lambda rows, _: 0.2 < np.isnan(values(rows)).mean() < 0.4),
    ("angle_offset_step", 1.0, {"step_deg": 7.0}, lambda rows, last: rows[0][0] == near(last[0] + 7.0)),
    ("angle_reversed", 1.0, {}, turned),
    ("angle_reversed", 0.1, {"about_present": False}, lambda rows, _: np.all(values(rows) - 10.0 < -60.0)),
    ("angle_noise_burst", 5.0, {"sd_deg": 3.0}, lambda rows, _: 3.8 < np.diff(values(rows)).std() < 4.7),
    ("angle_fault_bit", 1.0, {}, lambda rows, _: {row[2] for row in rows} == {1} and rows[-1][0] > rows[0][0]),
    ("angle_frames_lost", 10.0, {}, lambda rows, _: steps(rows) >= {1, 2} and 1750 < len(rows) < 1850),
    ("angle_frames_repeated", 5.0, {}, lambda rows, _: steps(rows) == {0, 1}),
    ("angle_counter_jump", 1.0, {"step": 500}, lambda rows, last: rows[0][1] == last[1] + 501),
    ("angle_rate_off", 10.0, {"percent": -8.0}, lambda rows, _: len(rows) == pytest.approx(1840, abs=2)),
]
"""A fault, for how long, its settings, and what its sensor's frames must show after the last one before it."""


@pytest.mark.parametrize(
    ("name", "seconds", "settings", "shows"), SHOWN, ids=[f"{name} {more}" for name, _, more, _ in SHOWN]
)
def test_it_shows(host: Host, name: str, seconds: float, settings: dict[str, Any], shows: Callable[..., Any]) -> None:
    can_id = ANGLE if name in OF_THE_ANGLE else CELL
    last = host.rows(0.1, can_id)[-1]
    with broken(host, name, **settings):
        rows = host.rows(seconds, can_id)
    assert shows(rows, last), rows[:20]


def test_every_fault_ends_without_a_trace_in_the_readings(host: Host) -> None:
    for name in library():
        with broken(host, name):
            host.answers(LL_CONFIG, PULSE)
            host.frames(0.1)
        host.frames(0.1)
        began_s, frames = host.timeline.now_s, host.frames(0.2)
        cell, angle = ([LAYOUT.unpack(f.data) for f in frames if f.can_id == can_id] for can_id in (CELL, ANGLE))
        assert (len(cell), len(angle)) == (pytest.approx(320, abs=1), pytest.approx(40, abs=1)), name
        assert steps(cell) == steps(angle) == {1} and {row[2] for row in angle} == {0}, name
        late_deg = values(angle) - 70.0 - 5.0 * (began_s + 0.005 * np.arange(len(angle)))
        assert np.abs(late_deg).max() < 0.05 and 3.0 < np.median(values(cell)) < 12.0, name


def test_errors_of_the_bus(host: Host) -> None:
    with broken(host, "error_frames", probability=0.5):
        errors = [frame for frame in host.frames() if frame.error]
        assert 0.4 < len(errors) / 800 < 0.6
    with broken(host, "bus_off"):
        assert [(frame.can_id, frame.error) for frame in host.frames()] == [(0x20000040, True)]


def test_delivery_jitter_keeps_order_and_stamps_and_loses_nothing_when_it_ends(host: Host) -> None:
    host.devices.faults.on("delivery_jitter", {"largest_s": 0.03}, for_s=0.5)
    frames = host.frames(0.6)
    for can_id, count in ((CELL, 960), (ANGLE, 120)):
        rows = [(LAYOUT.unpack(frame.data)[1], frame) for frame in frames if frame.can_id == can_id]
        assert len(rows) == count and {after[0] - before[0] for before, after in pairwise(rows)} == {1}
        late_s = np.array([frame.time_s - 1e-6 * frame.time_us for _, frame in rows])
        assert 0.008 < late_s.max() <= 0.03 and np.abs(late_s[-10:]).max() < 1e-6


def test_clock_jitter(host: Host) -> None:
    def spread_us() -> float:
        return float(np.diff([frame.time_us for frame in host.frames(2.0) if frame.can_id == CELL]).std())

    assert spread_us() == 0.0
    with broken(host, "clock_jitter", sd_us=100):
        assert spread_us() == pytest.approx(math.sqrt(2) * 100, rel=0.15)


def test_for_s_ends_by_itself(host: Host) -> None:
    host.devices.faults.on("cell_silent", {}, for_s=0.1)
    assert len(host.rows(0.5, CELL)) == pytest.approx(640, abs=1)
    assert host.devices.faults.active() == []


def test_an_angle_sensor_that_is_unplugged_starts_anew(host: Host) -> None:
    with broken(host, "angle_unplugged"):
        assert host.rows(1.0) == []
    assert host.rows(0.01)[0][1] == 0


def test_an_angle_is_delayed_by_what_was_asked_and_stamped_as_if_not(host: Host) -> None:
    now = host.timeline.now_s
    with broken(host, "angle_delayed", delay_s=0.2):
        rows = host.rows(1.0)
    late_deg = 70.0 + 5.0 * (now + 0.005 * np.arange(len(rows))) - values(rows)
    assert late_deg[-1] == pytest.approx(1.0, abs=0.03) and steps(rows) == {1}


def test_in_the_cells_frame_readings_fail_and_frames_are_the_cells() -> None:
    host = Host(angle="in-cell", cell="with_angle")
    host.devices.faults.on("angle_nan", {})
    host.devices.faults.on("angle_fault_bit", {})
    assert {struct.unpack("<fhBB", frame.data)[1::2] for frame in host.frames(0.1)} == {(-32768, 2)}
    with pytest.raises(HardwareSimError, match="use the load cell's fault"):
        host.devices.faults.on("angle_silent", {})


NONSENSE = {
    "angle_delayed": {"delay_s": math.nan}, "angle_rate_off": {"percent": -100.0}, "clock_jitter": {"sd_us": -1},
    "delivery_jitter": {"largest_s": math.nan},
}  # fmt: skip


def test_nonsense_is_told(host: Host) -> None:
    for name, settings in NONSENSE.items():
        with pytest.raises(HardwareSimError, match=f"'{name}': setting '{next(iter(settings))}'"):
            host.devices.faults.on(name, settings)
    assert host.devices.faults.active() == []
    armless = VirtualHost()
    for name in OF_THE_ANGLE:
        with pytest.raises(HardwareSimError, match="start it with --arm"):
            armless.devices.faults.on(name, {})


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

"""Sensors on a CAN bus: frames by their DBC description, and an adapter that is opened once and read for all."""

from __future__ import annotations

import json
import math
import os
import queue
import struct
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import serial

from stimrig.rig import config
from stimrig.rig.adapters import can_bus
from stimrig.rig.adapters.can_bus import CanBus, ReadAhead
from stimrig.rig.clock import MonotonicClock
from stimrig.rig.devices import can_angle_sensor, can_load_cell
from stimrig.rig.devices._can import CELL_FAULT, PACKAGED, SampleFrame
from stimrig.rig.devices.can_angle_sensor import CanAngleSensor
from stimrig.rig.devices.can_load_cell import CanLoadCell
from stimrig.rig.errors import ConfigError, DeviceError, WireError
from stimrig.rig.machine import Frame
from stimrig.rig.signals import AngleScale
from tests.rig.test_config import GOOD, load
from tests.rig.test_line import Line
from tests.simulator.virtual_time import VirtualMachine

COUNTS = """VERSION ""
BS_:
BU_: Cell
BO_ 610 Value: 8 Cell
 SG_ First : 7|16@0- (0.01,0) [0|0] "" Cell
 SG_ Second : 23|16@0- (0.01,0) [0|0] "" Cell
 SG_ Third : 39|16@0- (0.01,0) [0|0] "" Cell
 SG_ Index : 55|8@0+ (1,0) [0|0] "" Cell
"""


def test_the_default_frame():
    frame = SampleFrame(PACKAGED, None, ["Torque_Nm"], "Counter", "Sync")
    assert (frame.message.frame_id, frame.counter_modulus, frame.samples_per_frame) == (0x181, 65536, 1)
    got = frame.decode(struct.pack("<fHBB", -3.25, 65535, 1, 0))
    assert (got.values, got.counter, got.flag) == ((-3.25,), 65535, 1)
    assert frame.decode(struct.pack("<fHBB", 0, 0, 2, 0)).flag == 0
    for fault in (None, CELL_FAULT):
        frame = SampleFrame(PACKAGED, None, ["Torque_Nm"], "Counter", "Sync", fault=fault)
        for status in (0, 1, 2, 4, 128, 254, 255):
            (value,) = frame.decode(struct.pack("<fHBB", 5.0, 0, status, 0)).values
            assert math.isnan(value) == (fault is not None and status > 1), "every word but the good one"
    assert math.isnan(frame.decode(struct.pack("<fHBB", math.nan, 0, 0, 0)).values[0])


def test_a_value_that_has_a_word_is_no_reading(tmp_path: Path):
    path = tmp_path / "words.dbc"
    path.write_text(COUNTS + 'VAL_ 610 First -32768 "no reading" 32767 "overload" ;\nVAL_ 610 Index 9 "nine" ;\n')
    frame = SampleFrame(str(path), "Value", ["First", "Second"], "Index", None)
    for raw in (-32768, 32767):
        got = frame.decode(struct.pack(">hhhBB", raw, -32768, 0, 9, 0))
        assert math.isnan(got.values[0]) and got.values[1] == pytest.approx(-327.68) and got.counter == 9


def test_a_float_has_no_words(tmp_path: Path):
    packaged = resources.files("stimrig.rig.devices").joinpath(f"{PACKAGED}.dbc").read_text("utf-8")
    path = tmp_path / "float.dbc"
    path.write_text(packaged + 'VAL_ 385 Torque_Nm 0 "rest" ;\n')
    with pytest.raises(ConfigError, match="Torque_Nm: a floating-point signal has no words"):
        SampleFrame(str(path), None, ["Torque_Nm"], None, None)


def test_a_file_that_is_no_dbc(tmp_path: Path):
    path = tmp_path / "x.dbc"
    path.write_text("BO_ hello")
    with pytest.raises(ConfigError, match="not a DBC file"):
        SampleFrame(str(path), None, ["a"], None, None)
    with pytest.raises(ConfigError, match="no file"):
        SampleFrame("nothing", None, ["a"], None, None)


LAYOUTS = {
    "big-endian counts": (
        ("counts", "Value", ["First", "Second", "Third"], "Index", None), (610, 256, 3),
        struct.pack(">hhhBB", 100, -200, 300, 9, 0), (1.0, -2.0, 3.0), 9,
    ),
    "without a counter": (("counts", None, ["Second"], None, None), (610, 0, 1), bytes(8), (0.0,), -1),
    "three samples, a counter of frames": (
        ("torque_packed3", None, ["Torque1_Nm", "Torque2_Nm", "Torque3_Nm"], "Counter", None), (0x181, 65536, 3),
        struct.pack("<hhhH", 500, -250, 1, 40_000), (1.0, -0.5, 0.002), 40_000,
    ),
    "like a GSV-4's": (
        ("counts_be16", None, ["Torque1_Nm", "Torque2_Nm"], None, None), (610, 0, 2),
        b"\0\1\xff\xff", (-50.0, 50.0), -1,
    ),
}  # fmt: skip
"""By what is meant: how it is described, number, modulus and samples of the frame, its bytes, values and counter."""


@pytest.mark.parametrize("layout", LAYOUTS)
def test_several_samples_of_a_frame(tmp_path: Path, layout: str):
    (dbc, *how), told, data, values, counter = LAYOUTS[layout]
    (tmp_path / "counts.dbc").write_text(COUNTS)
    frame = SampleFrame(str(tmp_path / "counts.dbc") if dbc == "counts" else dbc, *how)
    assert (frame.message.frame_id, frame.counter_modulus, frame.samples_per_frame) == told
    found = frame.decode(data)
    assert found.values == pytest.approx(values, abs=1e-6 if dbc == "counts_be16" else None)
    assert (found.counter, found.flag) == (counter, 255)
    with pytest.raises(WireError, match=f"does not fit {frame.message.name}"):
        frame.decode(data[:-1] if dbc == "counts_be16" else b"\0\0")


MACHINE = VirtualMachine()


def sensor_of(bus: dict[str, Any], cell: can_load_cell.Settings | None = None, **more: Any) -> CanAngleSensor:
    settings = can_angle_sensor.Settings(device="can_angle_sensor", bus=bus, **more)
    return CanAngleSensor(settings if cell is None else settings.with_cell(cell), MACHINE)


def frame(data: bytes, host_time_s: float = 1000.0) -> Frame:
    return Frame(0x182, data, host_time_s, math.nan)


def test_a_frame_of_its_own():
    sensor = sensor_of({}, offset=10.0, direction=-1)
    assert (sensor.counter_modulus, sensor.sample_rate_hz) == (65536, 200.0)
    told = [(100.0, 0), (math.nan, 1), (-80.0, 0), (0.0, 2), (0.0, 254), (0.0, 255)]
    frames = [frame(struct.pack("<fHBB", degrees, i, status, 0)) for i, (degrees, status) in enumerate(told)]
    block = sensor.decode([*frames, frame(b"\0\0")], damaged=1, errors=2)
    assert (block.malformed, block.error_frames) == (2, 2)
    assert block.samples["raw"][[0, 2]].tolist() == [100.0, -80.0] and np.isnan(block.samples["raw"][1])
    assert np.degrees(block.samples["angle_rad"][[0, 2]]) == pytest.approx([-90.0, 90.0])
    assert block.samples["counter"].tolist() == list(range(6))
    assert block.samples["fault"].tolist() == [0, 1, 0, 1, 1, 1], "every word but the good one"


def test_a_signal_in_the_cells_own_frame():
    settings = can_load_cell.Settings(device="can_load_cell", bus={"channel": "in"}, dbc="torque_with_angle")
    cell, sensor = CanLoadCell(settings, MACHINE), sensor_of({}, settings, of_the_cell=True)
    assert (cell.counter_modulus, sensor.counter_modulus, sensor.sample_rate_hz) == (256, 256, 1600.0)
    with pytest.raises(DeviceError, match=r"angle_sensor\.of_the_cell: the load cell's bus is not open"):
        MACHINE.run(sensor.open(lambda _: None, lambda _: None))
    frames = [
        frame(struct.pack("<fhBB", 0.25 * i, -1234 + i if i < 4 else -32768, i, i % 2 + (0, 0, 0, 2, 254)[i]), 0.1 * i)
        for i in range(5)
    ]
    torques, angles = cell.decode(frames).samples, sensor.decode(frames).samples
    assert torques["torque_nm"].tolist() == [0, 0.25, 0.5, 0.75, 1.0]
    assert torques["sync"].tolist() == [0, 1, 0, 1, 0]
    assert angles["raw"] == pytest.approx([-12.34, -12.33, -12.32, -12.31, math.nan], nan_ok=True)
    assert angles["counter"].tolist() == torques["counter"].tolist() == list(range(5))
    assert angles["host_time_s"].tolist() == torques["host_time_s"].tolist() == [0.1 * i for i in range(5)]
    assert angles["fault"].tolist() == [0, 0, 0, 1, 1]


def test_the_rig_file_names_the_sensor(tmp_path: Path):
    def loaded(text: str) -> Any:
        return load(tmp_path, GOOD.partition("[limits]")[0] + text)

    assert loaded("").angle_sensor is None and list(loaded("").devices()) == ["stimulator", "load_cell"]
    found = loaded('[angle_sensor]\ndevice = "can_angle_sensor"\n[limits]\nangle_rad = [0.1, 2]\nangle_jump_rad = 0.05')
    assert found.angle_sensor.bus == found.load_cell.bus
    assert found.public()["angle_sensor"]["radians_per_unit"] == pytest.approx(0.0174532925)
    row = found.limits.table()["angle_rad"]
    assert (row.lo, row.hi, row.owner) == (0.1, 2.0, "rig file") and found.limits.table()["angle_jump_rad"].hi == 0.05
    for text, words in (
        ('[angle_sensor]\ndevice = "can_load_cell"', "angle_sensor.device: unknown device 'can_load_cell'"),
        ('[angle_sensor]\ndevice = "can_angle_sensor"\ndirection = 2', "angle_sensor.direction"),
        ('[angle_sensor]\ndevice = "can_angle_sensor"\nradians_per_unit = 0', "angle_sensor.radians_per_unit"),
        ('[angle_sensor]\ndevice = "can_angle_sensor"\noffset = nan', "angle_sensor.offset"),
        ('[angle_sensor]\ndevice = "can_angle_sensor"\nofset = 1', "angle_sensor.ofset: unknown key"),
        ("[limits]\nangle_rad = [2, 1]", "limits: rig file: angle_rad"),
        ("[limits]\nangle_rad = [nan, 1]", "angle_rad"),
        ("[limits]\nangle_rad = 1.0", "limits.angle_rad"),
    ):
        with pytest.raises(ConfigError, match=words):
            loaded(text)
    with pytest.raises(ConfigError, match=r"angle_sensor\.signal: angle_default has no signal"):
        CanAngleSensor(can_angle_sensor.Settings(device="can_angle_sensor", signal="Winkel"), MACHINE)


def test_the_emulators_line_says_what_a_calibration_would_find():
    """Of a sensor in the cell's frames; tests/wire has one with frames of its own."""
    line = {
        "stimulator": "/dev/pts/gone",
        "can": {"interface": "virtual", "channel": "e"},
        "cell": "with_angle",
        "load_cell": {"dbc": "torque_with_angle"},
        "angle_sensor": {"kind": "in_cell", "rate_hz": 100.0, "offset_deg": 12.5, "direction": -1, "scale": 1.25},
    }
    found = config.for_emulator(json.dumps(line), data_dir="/tmp/d", socket="/tmp/s")
    assert isinstance(found.angle_sensor, can_angle_sensor.Settings)
    sensor = can_angle_sensor.create(found.angle_sensor, MACHINE)
    assert sensor.scale == AngleScale(12.5, -1, math.radians(1.25))
    assert sensor.of_the_cell and sensor.sample_rate_hz == 1600.0


FRAMES = 40  # of 22 bytes: they fit into the buffer of a pseudo-terminal
PATIENCE_S = 30.0


class CountingPort:
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
    made = Line()
    yield made.ours, {"interface": "slcan", "channel": made.path}
    made.close()


def cell_of(machine: Adapters, bus: dict[str, Any], **more: Any) -> Opened:
    return Opened(machine, CanLoadCell(can_load_cell.Settings(device="can_load_cell", bus=bus, **more), machine))


def opened_sensor(machine: Adapters, bus: dict[str, Any]) -> Opened:
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
    cell, sensor = cell_of(machine, bus), opened_sensor(machine, bus)
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
    cell, sensor = cell_of(machine, bus), opened_sensor(machine, bus)
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
    cell, sensor = cell_of(machine, line[1]), opened_sensor(machine, line[1])
    os.close(line[0])
    machine.until(lambda: len(machine.lost) == 2)
    assert all("the bus was lost" in reason for reason in machine.lost)
    sensor.close()
    cell.close()
    assert len(machine.lost) == 2


def test_an_adapter_of_its_own_is_the_sensors(machine: Adapters):
    sensor = opened_sensor(machine, {"interface": "virtual", "channel": "own"})
    assert not sensor.device.on_the_cells_bus
    sensor.close()


def test_one_adapter_cannot_have_two_sets_of_arguments(machine: Adapters):
    bus = {"interface": "virtual", "channel": "two", "bitrate": 500_000}
    cell = cell_of(machine, bus)
    with pytest.raises(DeviceError, match=r"angle_sensor.bus: virtual two is already open with other arguments"):
        opened_sensor(machine, {**bus, "bitrate": 250_000})
    cell.close()


def test_a_port_that_is_no_serial_line_is_left_as_it_is(machine: Adapters):
    """A socket says only whether anything waits, not how much."""
    cell = cell_of(machine, {"interface": "slcan", "channel": "loop://"})
    assert not isinstance(cell.device._bus.can.serialPortOrig, ReadAhead)
    cell.close()


def test_a_cell_whose_start_frames_are_not_sent_is_refused_and_not_lost_as_well(
    machine: Adapters, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(CanBus, "send", Mock(side_effect=DeviceError("not sent")))
    with pytest.raises(DeviceError, match="not sent"):
        cell_of(machine, {"interface": "virtual", "channel": "deaf"}, start_frames=["000#0100"])
    assert not can_bus._open
    while not machine._posted.empty():
        machine._posted.get()()
    assert machine.lost == []

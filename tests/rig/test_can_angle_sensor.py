"""The angle sensor on a CAN bus: its own frame or the cell's, over an adapter that is opened once."""

from __future__ import annotations

import contextlib
import json
import math
import os
import pty
import struct
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from rig import config
from rig.clock import MonotonicClock
from rig.devices import _can_bus, can_angle_sensor, can_load_cell
from rig.devices.can_angle_sensor import CanAngleSensor
from rig.devices.can_load_cell import CanLoadCell
from rig.errors import ConfigError, DeviceError
from rig.signals import AngleScale

CLOCK = MonotonicClock()


def cell_of(bus: dict[str, Any], **more: Any) -> CanLoadCell:
    return CanLoadCell(can_load_cell.Settings(device="can_load_cell", bus=bus, **more), CLOCK)


def sensor_of(bus: dict[str, Any], cell: can_load_cell.Settings | None = None, **more: Any) -> CanAngleSensor:
    settings = can_angle_sensor.Settings(device="can_angle_sensor", bus=bus, **more)
    return CanAngleSensor(settings if cell is None else settings.beside(cell), CLOCK)


@pytest.fixture
def line() -> Iterator[tuple[int, dict[str, Any]]]:
    """Our end of an adapter that only one may open, and how the rig file calls it."""
    ours, theirs = pty.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    yield ours, {"interface": "slcan", "channel": os.ttyname(theirs)}
    os.close(theirs)
    with contextlib.suppress(OSError):
        os.close(ours)


def slcan(frame_id: int, data: bytes) -> bytes:
    return f"t{frame_id:03X}{len(data)}".encode() + data.hex().encode() + b"\r"


def torque(i: int) -> bytes:
    return slcan(0x181, struct.pack("<fHBB", 0.5 * i, i, 0, 0))


def angle(i: int, degrees: float, status: int = 0) -> bytes:
    return slcan(0x182, struct.pack("<fHBB", degrees, i, status, 0))


def virtual(channel: str) -> dict[str, Any]:
    return {"interface": "virtual", "channel": channel}


def read_all(device: Any, n: int) -> np.ndarray:
    found = np.concatenate([device.read(0.05).samples for _ in range(20)])
    assert len(found) == n
    return found


def test_a_frame_of_its_own():
    with can.Bus(**virtual("own")) as peer:
        sensor = sensor_of(virtual("own"), offset=10.0, direction=-1)
        identity = sensor.open()
        assert (identity["frame_id"], identity["message"], sensor.counter_modulus) == ("0x182", "Angle", 65536)
        assert not sensor.on_the_cells_bus
        for i, (degrees, status) in enumerate([(100.0, 0), (math.nan, 1), (-80.0, 254)]):
            peer.send(
                can.Message(
                    arbitration_id=0x182, is_extended_id=False, data=struct.pack("<fHBB", degrees, i, status, 0)
                )
            )
        peer.send(can.Message(arbitration_id=0x181, is_extended_id=False, data=bytes(8)))
        peer.send(can.Message(arbitration_id=0x182, is_extended_id=False, data=b"\0\0"))
        block = sensor.read(0.2)
        assert block.malformed == 1
        assert block.samples["raw"][[0, 2]].tolist() == [100.0, -80.0] and np.isnan(block.samples["raw"][1])
        assert np.degrees(block.samples["angle_rad"][[0, 2]]) == pytest.approx([-90.0, 90.0])
        assert block.samples["counter"].tolist() == [0, 1, 2] and block.samples["fault"].tolist() == [0, 1, 0]
        sensor.close()


def test_an_adapter_that_can_be_opened_once_is_shared(line: tuple[int, dict[str, Any]]):
    ours, bus = line
    cell, sensor = cell_of(bus), sensor_of(bus)
    cell.open()
    sensor.open()
    assert sensor.on_the_cells_bus
    os.write(ours, b"".join(torque(2 * i) + angle(i, 1.5 * i) + torque(2 * i + 1) for i in range(20)))
    torques, angles = read_all(cell, 40), read_all(sensor, 20)
    assert torques["counter"].tolist() == list(range(40)) and angles["counter"].tolist() == list(range(20))
    assert angles["raw"].tolist() == [1.5 * i for i in range(20)]
    after = np.searchsorted(torques["host_time_s"], angles["host_time_s"])  # the order of the frames is kept
    assert after.tolist() == [2 * i + 1 for i in range(20)]
    sensor.close()
    os.write(ours, torque(40) + angle(20, 0.0) + torque(41))
    assert len(read_all(cell, 2)) == 2  # the cell goes on alone
    cell.close()


def test_with_the_cells_bus_the_sensor_is_gone_and_comes_back_with_it(line: tuple[int, dict[str, Any]]):
    ours, bus = line
    cell, sensor = cell_of(bus), sensor_of(bus)
    cell.open()
    sensor.open()
    cell.close()
    for _ in range(2):
        with pytest.raises(DeviceError, match="angle sensor: the load cell's bus, which it shares, was closed"):
            sensor.read(0.05)
    sensor.close()
    cell.open()
    sensor.open()
    os.write(ours, angle(1, 2.0))
    cell.read(0.05)
    assert sensor.read(0.05).samples["raw"].tolist() == [2.0]
    sensor.close()
    cell.close()


def test_one_adapter_cannot_have_two_sets_of_arguments():
    cell = cell_of({**virtual("two"), "bitrate": 500_000})
    cell.open()
    with pytest.raises(DeviceError, match=r"angle_sensor.bus: virtual two is already open with other arguments"):
        sensor_of({**virtual("two"), "bitrate": 250_000}).open()
    cell.close()
    assert not _can_bus._open


def test_a_signal_in_the_cells_own_frame():
    settings = can_load_cell.Settings(device="can_load_cell", bus=virtual("in"), dbc="torque_with_angle")
    cell, sensor = CanLoadCell(settings, CLOCK), sensor_of({}, settings, of_the_cell=True)
    assert (cell.counter_modulus, sensor.counter_modulus, sensor.sample_rate_hz) == (256, 256, 1600.0)
    with pytest.raises(DeviceError, match=r"of_the_cell: the load cell's bus virtual in is not open"):
        sensor.open()
    with can.Bus(**virtual("in")) as peer:
        cell.open()
        sensor.open()
        for i in range(5):
            data = struct.pack("<fhBB", 0.25 * i, -1234 + i if i < 4 else -32768, i, i % 2 + 2 * (i > 2))
            peer.send(can.Message(arbitration_id=0x181, is_extended_id=False, data=data))
        torques, angles = cell.read(0.1).samples, sensor.read(0.1).samples
        assert torques["torque_nm"].tolist() == [0, 0.25, 0.5, 0.75, 1.0]
        assert torques["sync"].tolist() == [0, 1, 0, 1, 0]
        assert angles["raw"] == pytest.approx([-12.34, -12.33, -12.32, -12.31, math.nan], nan_ok=True)
        assert angles["counter"].tolist() == torques["counter"].tolist()
        assert angles["host_time_s"].tolist() == torques["host_time_s"].tolist()
        assert angles["fault"].tolist() == [0, 0, 0, 1, 1]
        sensor.close()
        cell.close()


def test_the_rig_file_names_the_sensor(tmp_path: Path):
    base = f"""data_dir = "{tmp_path}"
socket = "{tmp_path}/s"
[stimulator]
device = "p24"
port = "/dev/ttyUSB0"
[load_cell]
device = "can_load_cell"
bus = {{ interface = "slcan", channel = "/dev/ttyACM0" }}
"""

    def loaded(text: str) -> Any:
        path = tmp_path / "rig.toml"
        path.write_text(base + text)
        return config.load(path)

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
        CanAngleSensor(can_angle_sensor.Settings(device="can_angle_sensor", signal="Winkel"), CLOCK)


@pytest.mark.parametrize("kind", ["own", "in_cell"])
def test_the_emulators_line_says_what_a_calibration_would_find(kind: str):
    line = {
        "stimulator": "/dev/pts/gone",
        "can": virtual("e"),
        "cell": "with_angle" if kind == "in_cell" else "plain",
        "angle_sensor": {
            "kind": kind, "frame_id": 386, "rate_hz": 100.0, "offset_deg": 12.5, "direction": -1, "scale": 1.25
        },
    }  # fmt: skip

    found = config.for_emulator(json.dumps(line), data_dir="/tmp/d", socket="/tmp/s")
    assert isinstance(found.angle_sensor, can_angle_sensor.Settings)
    sensor = can_angle_sensor.create(found.angle_sensor, CLOCK)
    assert sensor.scale == AngleScale(12.5, -1, math.radians(1.25))
    assert sensor.of_the_cell == (kind == "in_cell")
    assert sensor.sample_rate_hz == (1600.0 if kind == "in_cell" else 100.0)
    without = config.for_emulator(json.dumps({**line, "angle_sensor": None}), data_dir="/tmp/d", socket="/tmp/s")
    assert without.angle_sensor is None

"""The angle sensor on a CAN bus: its own frame or the cell's, and what the rig file says of it."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stimrig.rig import config
from stimrig.rig.devices import can_angle_sensor, can_load_cell
from stimrig.rig.devices.can_angle_sensor import CanAngleSensor
from stimrig.rig.devices.can_load_cell import CanLoadCell
from stimrig.rig.errors import ConfigError, DeviceError
from stimrig.rig.machine import Frame
from stimrig.rig.signals import AngleScale
from tests.rig.test_config import GOOD, load
from tests.simulator.virtual_time import VirtualMachine

MACHINE = VirtualMachine()


def sensor_of(bus: dict[str, Any], cell: can_load_cell.Settings | None = None, **more: Any) -> CanAngleSensor:
    settings = can_angle_sensor.Settings(device="can_angle_sensor", bus=bus, **more)
    return CanAngleSensor(settings if cell is None else settings.beside(cell), MACHINE)


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


@pytest.mark.parametrize("kind", ["own", "in_cell"])
def test_the_emulators_line_says_what_a_calibration_would_find(kind: str):
    line = {
        "stimulator": "/dev/pts/gone",
        "can": {"interface": "virtual", "channel": "e"},
        "cell": "with_angle" if kind == "in_cell" else "plain",
        "angle_sensor": {
            "kind": kind, "frame_id": 386, "rate_hz": 100.0, "offset_deg": 12.5, "direction": -1, "scale": 1.25
        },
    }  # fmt: skip

    found = config.for_emulator(json.dumps(line), data_dir="/tmp/d", socket="/tmp/s")
    assert isinstance(found.angle_sensor, can_angle_sensor.Settings)
    sensor = can_angle_sensor.create(found.angle_sensor, MACHINE)
    assert sensor.scale == AngleScale(12.5, -1, math.radians(1.25))
    assert sensor.of_the_cell == (kind == "in_cell")
    assert sensor.sample_rate_hz == (1600.0 if kind == "in_cell" else 100.0)
    without = config.for_emulator(json.dumps({**line, "angle_sensor": None}), data_dir="/tmp/d", socket="/tmp/s")
    assert without.angle_sensor is None

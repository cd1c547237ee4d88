"""The joint's angle: encoder, its own frames byte for byte, its clock, and the angle in the cell's frame."""

from __future__ import annotations

import math
import struct
from itertools import pairwise
from typing import Any

import can
import numpy as np
import pytest

from stimrig.hardware_sim.angle_sensor import AngleSensor, Encoder
from stimrig.hardware_sim.load_cells.cells import WithAngle
from stimrig.hardware_sim.load_cells.frames import AngleReading, Frame, Sample
from stimrig.hardware_sim.load_cells.sampler import LoadCell
from stimrig.hardware_sim.sampling import take_in_order
from stimrig.hardware_sim.settings import Settings
from tests.hardware_sim.emulated import emulated, wait_for
from tests.hardware_sim.test_load_cells import Ramp, listen

OWN, IN_CELL = struct.Struct("<fHBB"), struct.Struct("<fhBB")


def encoder(angle_deg: Any = lambda time_s: 10.0 * time_s, seed: int = 0, **mounting: Any) -> Encoder:
    settings = {f"angle_{name}": value for name, value in {"noise_deg": 0.0, **mounting}.items()}
    return Encoder(angle_deg, Settings(**settings, noise_seed=seed))


def sensor(read: Encoder, until_s: float, **clock: Any) -> list[Frame]:
    sent: list[Frame] = []
    take_in_order([AngleSensor(read, sent.append, Settings(**clock))], until_s)
    return sent


class TestEncoder:
    def test_zero_direction_and_scale_are_its_own(self) -> None:
        read = encoder(lambda _: 60.0, offset_deg=100.0, direction=-1, scale=1.25, bits=20)
        raw_deg = read.read(0.0).angle_deg
        assert raw_deg == pytest.approx(100.0 - 60.0 / 1.25, abs=360 / 2**20)
        assert -1 * 1.25 * (raw_deg - 100.0) == pytest.approx(60.0, abs=1e-3)

    @pytest.mark.parametrize("bits", [12, 13, 14])
    def test_it_reads_in_steps(self, bits: int) -> None:
        read = encoder(bits=bits)
        raw_deg = np.array([read.read(0.001 * k).angle_deg for k in range(2000)])
        steps = raw_deg / (360.0 / 2**bits)
        assert steps == pytest.approx(np.round(steps), abs=1e-9)
        error_deg = raw_deg - 0.01 * np.arange(2000)
        assert error_deg.std() == pytest.approx(360.0 / 2**bits / math.sqrt(12), rel=0.1)

    def test_noise_comes_before_the_steps_and_by_the_seed(self) -> None:
        def readings(seed: int) -> np.ndarray:
            read = encoder(lambda _: 45.0, seed=seed, noise_deg=0.1, bits=14)
            return np.array([read.read(0.0).angle_deg for _ in range(3000)])

        first = readings(1)
        assert np.array_equal(first, readings(1))
        assert not np.array_equal(first, readings(2))
        assert first.std() == pytest.approx(0.1, rel=0.05)
        assert abs(first.mean() - 45.0) < 0.01


class TestOwnFrames:
    def test_bytes(self) -> None:
        read = encoder(lambda _: 90.0, bits=12)
        read.fault = True
        (frame,) = sensor(read, 0.001)
        assert (frame.can_id, frame.data) == (0x182, bytes.fromhex("0000b442") + b"\x00\x00\x01\x00")
        read.fault = False
        assert [each.data[4:] for each in sensor(read, 0.011)] == [b"\0\0\0\0", b"\1\0\0\0", b"\2\0\0\0"]

    def test_its_clock_drifts_and_does_not_know(self) -> None:
        frames = sensor(encoder(lambda time_s: time_s, bits=20), 100.0, angle_clock_ppm=-500.0)
        assert len(frames) == pytest.approx(20_000 * (1 - 500e-6), abs=1)
        stamps_s = np.array([frame.time_us for frame in frames]) * 1e-6
        assert np.diff(stamps_s) == pytest.approx(np.full(stamps_s.size - 1, 0.005), abs=2e-6)


def test_two_sensors_take_turns_by_their_clocks() -> None:
    """A limb's time only advances, so nobody may read it at an earlier time than the one before."""
    read_at_s: list[float] = []

    class Watched(Ramp):
        def torque_nm(self, time_s: float) -> float:
            read_at_s.append(time_s)
            return time_s

    def angle_deg(time_s: float) -> float:
        read_at_s.append(time_s)
        return time_s

    settings = Settings(clock_jitter_us=100.0, angle_rate_hz=333.0, angle_clock_ppm=800.0, angle_jitter_us=500.0)
    cell = LoadCell(Watched(), settings)
    angle = AngleSensor(encoder(angle_deg), cell.add_frame, settings)
    for until_s in np.cumsum(np.random.default_rng(0).uniform(0, 0.02, 100)):
        take_in_order([cell, angle], until_s)
    assert all(before <= after for before, after in pairwise(read_at_s))
    frames = cell.take_frames()
    assert {frame.can_id for frame in frames} == {0x181, 0x182}
    assert len(read_at_s) == len(frames)


class TestInTheCellsFrame:
    def encoded(self, angle_deg: float, fault: bool = False, counter: int = 0, sync: bool = False) -> bytes:
        return WithAngle().encode([Sample(1.5, counter, sync, 0, AngleReading(angle_deg, fault))]).data

    def test_bytes(self) -> None:
        assert self.encoded(-12.34, counter=0x1FE, sync=True) == bytes.fromhex("0000c03f") + b"\x2e\xfb\xfe\x01"
        assert self.encoded(90.0, fault=True) == bytes.fromhex("0000c03f") + b"\x28\x23\x00\x02"

    def test_an_angle_has_stops_and_nothing_is_the_lowest_count(self) -> None:
        counts = [IN_CELL.unpack(self.encoded(angle))[1] for angle in (400.0, -400.0, math.nan, math.inf)]
        assert counts == [32767, -32767, -32768, -32768]
        assert IN_CELL.unpack(WithAngle().encode([Sample(0.0, 0, False, 0)]).data)[1] == -32768

    def test_it_is_read_when_the_torque_is(self) -> None:
        read = encoder(lambda time_s: 100.0 * time_s, bits=20)
        cell = LoadCell(
            Ramp(), Settings(cell="with_angle", noise_nm=0.0, rate_hz=400.0, clock_ppm=5000.0), read_angle=read.read
        )
        cell.produce(2.0)
        rows = [IN_CELL.unpack(frame.data) for frame in cell.take_frames()]
        assert len(rows) == pytest.approx(804, abs=1)
        assert [angle for _, angle, *_ in rows] == pytest.approx([1e4 * torque for torque, *_ in rows], abs=0.6)


@pytest.mark.wire
class TestOverTheWire:
    def test_both_come_on_one_bus_and_none_is_lost(self) -> None:
        with (
            emulated("--arm", "held,angle_deg=60", "--angle-offset-deg", "20") as rig,
            can.Bus(**rig.ready["can"]) as bus,
        ):
            assert rig.ready["angle_sensor"] == {
                "kind": "own", "frame_id": 386, "rate_hz": 200.0, "offset_deg": 20.0, "direction": 1, "scale": 1.0,
            }  # fmt: skip
            rows = [OWN.unpack(message.data) for message in listen(bus, 1800) if message.arbitration_id == 0x182]
        assert len(rows) == pytest.approx(200, abs=10)
        assert {(later[1] - earlier[1]) & 0xFFFF for earlier, later in pairwise(rows)} == {1}
        assert [row[0] for row in rows] == pytest.approx([80.0] * len(rows), abs=0.15)

    def test_the_control_line_moves_the_arm(self) -> None:
        with emulated("--arm", "held,angle_deg=70") as rig:
            assert rig.ask(cmd="arm", mode="held", angle_deg=130, deg_s=200)["ok"]
            wait_for(lambda: rig.ask(cmd="state")["angle_deg"] > 129.0)
            for bad in ({"mode": "fly"}, {"mode": "held", "angle_deg": math.nan}, {"mode": "waves", "hz": [1, 2]}):
                answer = rig.ask(cmd="arm", **bad)
                assert not answer["ok"]
                assert "arm" in answer["error"]
            assert rig.ask(cmd="state")["arm"] == "held"

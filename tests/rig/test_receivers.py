"""The receivers of torque and angle: counters that wrap, samples lost, repeated and late, a sensor that is gone."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig.rig.acquire.angle_receiver import REOPEN_S, AngleReceiver
from stimrig.rig.acquire.receiver import Receiver
from stimrig.rig.acquire.stream import LONGEST_READ_S, LOOK_AT, LOOK_S, SILENCE_S, CounterUnwrapper
from stimrig.rig.signals import SAMPLE, AngleScale, Block
from tests.rig.fakes import RATE_HZ, FakeCell, FakeSensor, FakeStimulator, journal_at
from tests.simulator.virtual_time import VirtualMachine


@given(st.integers(0, 65535), st.lists(st.integers(1, 300), min_size=1, max_size=300), st.integers(1, 40))
def test_a_wrapping_counter_is_unwrapped(first: int, steps: list[int], per_block: int):
    true = first + np.cumsum(steps)
    unwrapper, got = CounterUnwrapper(65536), []
    for at in range(0, len(true), per_block):
        counter, keep, repeats, late = unwrapper.unwrap(true[at : at + per_block] % 65536)
        assert keep.all()
        assert (repeats, late) == (0, 0)
        got += list(counter)
    assert np.array_equal(np.array(got) - got[0], true - true[0])


def test_repeats_and_late_samples_are_left_out():
    counter, keep, repeats, late = CounterUnwrapper(65536).unwrap(np.array([65534, 65535, 65535, 1, 0, 2]))
    assert list(counter[keep]) == [65534, 65535, 65537, 65538]
    assert (repeats, late) == (1, 1)


def block(counters: list[int], torque_nm: float = 1.0) -> Block:
    samples = np.zeros(len(counters), SAMPLE)
    samples["counter"], samples["torque_nm"], samples["host_time_s"] = counters, torque_nm, 1000.0
    return Block(samples, malformed=1, error_frames=2)


class Heard(Receiver):
    """Of a cell that only gives what a test hands over."""

    def __init__(self, rate_hz: float = RATE_HZ) -> None:
        self.machine, self.lost = VirtualMachine(), list[str]()
        self.cell = FakeCell(self.machine.clock, FakeStimulator(self.machine.clock))
        self.cell.sample_rate_hz = rate_hz
        super().__init__(self.cell, self.machine.tasks, self.lost.append)

    def begin(self, path: Path) -> None:
        self.record(journal_at(path), (-10, 10), lambda _: None)


def test_counts(tmp_path: Path):
    receiver = Heard()
    receiver.add(block([1, 2, 5]))
    receiver.begin(tmp_path / "j")
    receiver.add(block([6, 9, 9, 8, 10]))
    counts = receiver.release()
    assert counts.samples == 3  # 6, 9, 10
    assert counts.lost_samples == 2  # 7 and 8: the 8 that came late has no place any more
    assert (counts.duplicate_samples, counts.disordered_samples) == (1, 1)
    assert (counts.malformed_frames, counts.error_frames) == (1, 2)


@pytest.mark.parametrize("per_block", [1, 7, 40, 1000])
def test_the_range_does_not_depend_on_how_the_bus_cut_the_samples(tmp_path: Path, per_block: int):
    receiver = Heard()
    for name in ("first", "again"):  # what the first recording left over is not part of the next, nor is its range
        torque_nm = np.random.default_rng(0).normal(2.0, 0.1 if name == "first" else 0.01, 999)
        receiver.begin(tmp_path / name)
        for at in range(0, 999, per_block):
            part = block(list(range(at, min(at + per_block, 999))))
            part.samples["counter"] += 0 if name == "first" else 2000
            part.samples["torque_nm"] = torque_nm[at : at + per_block]
            receiver.add(part)
        means_nm = torque_nm[:992].reshape(-1, 16).mean(axis=1)  # 10 ms at 1600 samples/s
        assert receiver.range_nm == pytest.approx((means_nm.min(), means_nm.max()))


def test_every_sample_of_a_slow_cell_counts_for_the_range(tmp_path: Path):
    receiver = Heard(rate_hz=10.0)
    receiver.begin(tmp_path / "j")
    receiver.add(block([1], torque_nm=1.0))
    receiver.add(block([2], torque_nm=3.0))
    assert receiver.range_nm == (1.0, 3.0)


def test_a_cell_is_silent_after_a_second_of_reading_not_of_standing_still():
    receiver = Heard()
    clock, receiver.cell.silent = receiver.machine.clock, True
    receiver.machine.run(receiver.open())
    began_s = clock.now_s()
    clock.call_at(began_s + 0.01, lambda: clock.advance(2 * SILENCE_S))
    assert clock.run(receiver.machine.tasks, began_s + 60.0, lambda: bool(receiver.lost))
    assert receiver.lost == [f"load cell on can0: silent for 1 s; {LOOK_AT}"]
    read_s = clock.now_s() - began_s - 2 * SILENCE_S
    assert SILENCE_S - LONGEST_READ_S < read_s < SILENCE_S - LONGEST_READ_S + 2 * LOOK_S
    assert not receiver.cell.is_open
    assert not receiver.living


def swinging(time_s: float) -> float:
    return 1.0 + 0.5 * math.sin(time_s)


class HeardAngle:
    def __init__(self) -> None:
        self.machine = VirtualMachine()
        self.clock, self.wait = self.machine.clock, self.machine.wait
        self.sensor = FakeSensor(self.machine, swinging)
        self.sensor.noise_deg, self.sensor.per_block = 0.0, 1
        self.receiver = AngleReceiver(self.sensor, self.machine.tasks)

    def feed(self, duration_s: float) -> AngleReceiver:
        """Samples for so long."""
        if not self.receiver.living:
            self.receiver.start()
        self.wait(duration_s)
        return self.receiver

    def until(self, true: Callable[[], bool]) -> float:
        """Let time pass until something is true; when it was."""
        assert self.clock.run(self.machine.tasks, self.clock.now_s() + 60.0, true)
        return self.clock.now_s()


@pytest.fixture
def heard() -> HeardAngle:
    return HeardAngle()


def test_angle_and_velocity_of_now(heard: HeardAngle):
    receiver, clock = heard.receiver, heard.clock
    assert receiver.angle_rad is None and receiver.data_age_s(clock.now_s()) == math.inf
    heard.feed(1.0)
    assert receiver.angle_rad == pytest.approx(swinging(receiver.last_s or 0.0))
    assert receiver.velocity_rad_s == pytest.approx(0.5 * math.cos((receiver.last_s or 0.0) - 0.025), abs=1e-3)
    assert receiver.data_age_s(clock.now_s()) < 0.02
    rows = np.concatenate(tuple(receiver.live))
    assert rows.shape[1] == 3 and len(rows) == receiver._total


def test_a_calibration_holds_from_now_on_and_for_what_was_just_read(heard: HeardAngle):
    heard.sensor.angle_rad = lambda _: 1.0
    receiver = heard.feed(0.8)
    receiver.rescale(AngleScale(30.0, -1, 2 * math.pi / 180))
    assert receiver.angle_around(0.5) == pytest.approx(2.0)
    heard.feed(0.2)
    assert receiver.angle_rad == pytest.approx(2.0)
    assert receiver.velocity_rad_s == pytest.approx(0.0, abs=1e-6)


def test_a_sensor_that_starts_again_counts_on_by_the_clock(heard: HeardAngle):
    heard.receiver.start()
    heard.wait(1.0)
    before = heard.receiver._previous
    heard.sensor.on_lost("angle sensor: unplugged")
    heard.sensor.gone = True
    heard.wait(3.0)
    heard.sensor.gone, heard.sensor.counter, heard.sensor.opens_s = False, 0, 1.0
    heard.wait(2.0)
    after = heard.receiver._previous
    assert before is not None and after is not None
    counted, passed_s = after[0] - before[0], after[1] - before[1]
    assert passed_s > 4.5 and counted == pytest.approx(200 * passed_s, abs=5)
    assert heard.receiver.counts.disordered_samples == 0


def test_a_sensor_that_was_without_power_for_a_moment_counts_on_soon(heard: HeardAngle):
    heard.feed(1.0)
    heard.sensor.counter = 0
    began_s = heard.clock.now_s()
    receiver = heard.feed(0.3)
    assert receiver.data_age_s(heard.clock.now_s()) < 0.03
    assert receiver.counts.disordered_samples <= 12  # 50 ms until it is believed
    assert receiver._previous is not None and receiver._previous[1] > began_s + 0.25


def test_one_sample_that_is_no_number_leaves_no_angle(heard: HeardAngle):
    receiver = heard.feed(0.5)
    heard.sensor.nan = True
    receiver.add(heard.sensor.block(1))
    assert receiver.angle_around(0.1) is None


def test_blocks_longer_than_half_of_a_small_counter_are_unwrapped():
    """148 frames at once after a standstill, of a cell that counts to 256."""
    unwrapper = CounterUnwrapper(256)
    true = 40 + np.arange(500)
    got = [unwrapper.unwrap(true[part] % 256) for part in (slice(0, 30), slice(30, 178), slice(178, 500))]
    assert np.array_equal(np.concatenate([counter for counter, *_ in got]), true)
    assert all(keep.all() for _, keep, *_ in got)


def test_a_missing_sensor_is_tried_again_and_told(heard: HeardAngle):
    receiver, sensor = heard.receiver, heard.sensor
    sensor.gone = True
    began_s = heard.clock.now_s()
    receiver.start()
    heard.wait(0.1)
    assert (receiver.problem, receiver.identity) == ("angle sensor: no adapter", {})
    sensor.gone = False
    assert heard.until(lambda: receiver.angle_rad is not None) == pytest.approx(began_s + REOPEN_S)
    assert (receiver.problem, receiver.identity) == ("", {"device": "here"})
    lost_s = heard.clock.now_s()
    sensor.on_lost("angle sensor on x: the bus was lost: gone")
    assert "the bus was lost" in receiver.problem
    assert (receiver.angle_rad, receiver.velocity_rad_s) == (None, None)
    assert heard.until(lambda: receiver.angle_rad is not None) == pytest.approx(lost_s + REOPEN_S)
    assert sensor.done == ["opened", "closed", "opened"]


@pytest.mark.parametrize("how", ["silent", "repeating"])
def test_silence_is_told_and_ends_when_an_angle_comes(heard: HeardAngle, how: str):
    receiver, sensor = heard.receiver, heard.sensor
    receiver.start()
    heard.wait(1.0)
    setattr(sensor, how, True)
    began_s = heard.clock.now_s()
    told_s = heard.until(lambda: bool(receiver.problem))
    assert told_s - began_s == pytest.approx(SILENCE_S, abs=2.1 * LOOK_S)
    assert receiver.problem == f"angle sensor on its bus: silent for 1 s; {LOOK_AT}"
    setattr(sensor, how, False)
    assert heard.until(lambda: not receiver.problem) - told_s == pytest.approx(REOPEN_S, abs=0.02)
    heard.machine.run(receiver.close())
    heard.wait(1.0)
    assert sensor.done[:3] == ["opened", "closed", "opened"]
    assert set(sensor.done[3:]) == {"closed"}
    age_s = receiver.age_s(heard.clock.now_s())
    assert age_s == pytest.approx(1.0, abs=0.02), "nothing is read any more"


def test_an_adapter_that_opens_while_the_rig_disconnects_is_closed(heard: HeardAngle):
    heard.sensor.opens_s = 0.3
    heard.receiver.start()
    heard.wait(0.1)
    heard.machine.run(heard.receiver.close())  # who closes does not wait for it
    assert heard.clock.now_s() == pytest.approx(1000.1)
    heard.wait(1.0)
    assert heard.sensor.done == ["closed", "opened", "closed"]
    assert heard.receiver.angle_rad is None


def test_an_adapter_is_opened_again_only_once_it_is_closed(heard: HeardAngle):
    heard.sensor.closes_s = 2.0
    heard.receiver.start()
    heard.wait(0.1)
    heard.sensor.on_lost("angle sensor: unplugged")
    heard.wait(4.0)
    assert heard.sensor.done == ["opened", "closed", "opened"]

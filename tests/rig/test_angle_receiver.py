"""The angle receiver: counters, what is told of the newest angle, and a sensor that is gone and comes back."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from stimrig.rig.acquire.angle_receiver import REOPEN_S, AngleReceiver
from stimrig.rig.acquire.stream import LOOK_S, SILENCE_S, CounterUnwrapper
from stimrig.rig.signals import AngleScale
from tests.rig.angle import OpenedSensor
from tests.simulator.virtual_time import VirtualMachine


def swinging(time_s: float) -> float:
    return 1.0 + 0.5 * math.sin(time_s)


class Heard:
    """A sensor's receiver in virtual time."""

    def __init__(self) -> None:
        self.machine = VirtualMachine()
        self.clock, self.wait = self.machine.clock, self.machine.wait
        self.sensor = OpenedSensor(self.machine, swinging)
        self.sensor.noise_deg, self.sensor.per_block = 0.0, 1
        self.receiver = AngleReceiver(self.sensor, self.machine.tasks)

    def feed(self, duration_s: float) -> AngleReceiver:
        """Samples for so long, of a sensor that nobody opened."""
        self.sensor.feed(self.receiver, self.clock.now_s() + duration_s)
        self.wait(duration_s)
        return self.receiver

    def until(self, true: Callable[[], bool]) -> float:
        """Let time pass until something is true; when it was."""
        assert self.clock.run(self.machine.tasks, self.clock.now_s() + 60.0, true)
        return self.clock.now_s()


@pytest.fixture
def heard() -> Heard:
    return Heard()


def test_angle_and_velocity_of_now(heard: Heard):
    receiver, clock = heard.receiver, heard.clock
    assert receiver.angle_rad is None and receiver.data_age_s(clock.now_s()) == math.inf
    heard.feed(1.0)
    assert receiver.angle_rad == pytest.approx(swinging(receiver.last_s or 0.0))
    assert receiver.velocity_rad_s == pytest.approx(0.5 * math.cos((receiver.last_s or 0.0) - 0.025), abs=1e-3)
    assert receiver.data_age_s(clock.now_s()) < 0.02
    rows = np.concatenate(tuple(receiver.live))
    assert rows.shape[1] == 3 and len(rows) == receiver._total


def test_an_angle_that_comes_late_is_old(heard: Heard):
    heard.feed(1.0)
    heard.sensor.late_s = 0.25
    receiver = heard.feed(1.0)
    assert receiver.age_s(heard.clock.now_s()) < 0.02
    assert receiver.data_age_s(heard.clock.now_s()) == pytest.approx(0.25, abs=0.05)


def test_a_calibration_holds_from_now_on_and_for_what_was_just_read(heard: Heard):
    heard.sensor.angle_rad = lambda _: 1.0
    receiver = heard.feed(0.8)
    receiver.rescale(AngleScale(30.0, -1, 2 * math.pi / 180))
    assert receiver.angle_around(0.5) == pytest.approx(2.0)
    heard.feed(0.2)
    assert receiver.angle_rad == pytest.approx(2.0)
    assert receiver.velocity_rad_s == pytest.approx(0.0, abs=1e-6)


def test_a_sensor_that_starts_again_counts_on_by_the_clock(heard: Heard):
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


def test_a_sensor_that_was_without_power_for_a_moment_counts_on_soon(heard: Heard):
    heard.feed(1.0)
    heard.sensor.counter = 0
    began_s = heard.clock.now_s()
    receiver = heard.feed(0.3)
    assert receiver.data_age_s(heard.clock.now_s()) < 0.03
    assert receiver.counts.disordered_samples <= 12  # 50 ms until it is believed
    assert receiver._previous is not None and receiver._previous[1] > began_s + 0.25


def test_one_sample_that_is_no_number_leaves_no_angle(heard: Heard):
    receiver = heard.feed(0.5)
    heard.sensor.nan = True
    receiver.take(heard.sensor.block(1))
    assert receiver.angle_around(0.1) is None


def test_blocks_longer_than_half_of_a_small_counter_are_unwrapped():
    """148 frames at once after a standstill, of a cell that counts to 256."""
    unwrapper = CounterUnwrapper(256)
    true = 40 + np.arange(500)
    got = [unwrapper.unwrap(true[part] % 256) for part in (slice(0, 30), slice(30, 178), slice(178, 500))]
    assert np.array_equal(np.concatenate([counter for counter, *_ in got]), true)
    assert all(keep.all() for _, keep, *_ in got)


def test_a_missing_sensor_is_tried_again_and_told(heard: Heard):
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
def test_silence_is_told_and_ends_when_an_angle_comes(heard: Heard, how: str):
    receiver, sensor = heard.receiver, heard.sensor
    receiver.start()
    heard.wait(1.0)
    setattr(sensor, how, True)
    began_s = heard.clock.now_s()
    told_s = heard.until(lambda: bool(receiver.problem))
    assert told_s - began_s == pytest.approx(SILENCE_S, abs=2.1 * LOOK_S)
    assert receiver.problem == "angle sensor: silent for 1 s; check its cable and supply"
    setattr(sensor, how, False)
    assert heard.until(lambda: not receiver.problem) - told_s == pytest.approx(REOPEN_S, abs=0.02)
    heard.machine.run(receiver.close())
    heard.wait(1.0)
    assert sensor.done[:3] == ["opened", "closed", "opened"]
    assert set(sensor.done[3:]) == {"closed"}
    age_s = receiver.age_s(heard.clock.now_s())
    assert age_s == pytest.approx(1.0, abs=0.02), "nothing is read any more"


def test_an_adapter_that_opens_while_the_rig_disconnects_is_closed(heard: Heard):
    heard.sensor.opens_s = 0.3
    heard.receiver.start()
    heard.wait(0.1)
    heard.machine.run(heard.receiver.close())  # who closes does not wait for it
    assert heard.clock.now_s() == pytest.approx(1000.1)
    heard.wait(1.0)
    assert heard.sensor.done == ["closed", "opened", "closed"]
    assert heard.receiver.angle_rad is None


def test_an_adapter_is_opened_again_only_once_it_is_closed(heard: Heard):
    heard.sensor.closes_s = 2.0
    heard.receiver.start()
    heard.wait(0.1)
    heard.sensor.on_lost("angle sensor: unplugged")
    heard.wait(4.0)
    assert heard.sensor.done == ["opened", "closed", "opened"]

"""The angle receiver: counters, what is told of the newest angle, and a sensor that is gone and comes back."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import pytest

from rig.acquire.angle_receiver import REOPEN_S, AngleReceiver
from rig.acquire.stream import SILENCE_S, CounterUnwrapper
from rig.clock import VirtualClock
from rig.errors import DeviceError
from rig.signals import AngleBlock, AngleScale
from tests.rig.angle import FakeSensor


def swinging(time_s: float) -> float:
    return 1.0 + 0.5 * math.sin(time_s)


def made(angle_rad: Any = swinging) -> tuple[VirtualClock, FakeSensor, AngleReceiver]:
    clock = VirtualClock()
    sensor = FakeSensor(clock, angle_rad)
    sensor.noise_deg = 0.0
    return clock, sensor, AngleReceiver(sensor, clock)


def run(clock: VirtualClock, sensor: FakeSensor, receiver: AngleReceiver, duration_s: float) -> None:
    sensor.feed(receiver, clock.now_s() + duration_s)
    clock.wait(clock.now_s() + duration_s)


def test_angle_and_velocity_of_now():
    clock, sensor, receiver = made()
    assert receiver.angle_rad is None and receiver.data_age_s(clock.now_s()) == math.inf
    run(clock, sensor, receiver, 1.0)
    assert receiver.angle_rad == pytest.approx(swinging(receiver.last_s or 0.0))
    assert receiver.velocity_rad_s == pytest.approx(0.5 * math.cos((receiver.last_s or 0.0) - 0.025), abs=1e-3)
    assert receiver.data_age_s(clock.now_s()) < 0.02
    rows = np.concatenate(tuple(receiver.live))
    assert rows.shape[1] == 3 and len(rows) == receiver._total


def test_an_angle_that_comes_late_is_old():
    clock, sensor, receiver = made()
    run(clock, sensor, receiver, 1.0)
    sensor.late_s = 0.25
    run(clock, sensor, receiver, 1.0)
    assert receiver.age_s(clock.now_s()) < 0.02
    assert receiver.data_age_s(clock.now_s()) == pytest.approx(0.25, abs=0.05)


def test_a_calibration_holds_from_now_on_and_for_what_was_just_read():
    clock, sensor, receiver = made(lambda _: 1.0)
    run(clock, sensor, receiver, 0.8)
    receiver.rescale(AngleScale(30.0, -1, 2 * math.pi / 180))
    assert receiver.angle_around(0.5) == pytest.approx(2.0)
    run(clock, sensor, receiver, 0.2)
    assert receiver.angle_rad == pytest.approx(2.0)
    assert receiver.velocity_rad_s == pytest.approx(0.0, abs=1e-6)


def test_a_sensor_that_starts_again_counts_on_by_the_clock():
    clock, sensor, receiver = made()
    run(clock, sensor, receiver, 1.0)
    before = receiver._previous
    clock.wait(clock.now_s() + 3.0)
    receiver._begin_anew()
    sensor.counter = 0
    run(clock, sensor, receiver, 0.1)
    assert before is not None and receiver._previous is not None
    counted, passed_s = receiver._previous[0] - before[0], receiver._previous[1] - before[1]
    assert counted == pytest.approx(200 * passed_s, abs=5)
    assert receiver.counts.disordered_samples == 0


def test_a_sensor_that_was_without_power_for_a_moment_counts_on_soon():
    clock, sensor, receiver = made()
    run(clock, sensor, receiver, 1.0)
    sensor.counter = 0
    began_s = clock.now_s()
    run(clock, sensor, receiver, 0.3)
    assert receiver.data_age_s(clock.now_s()) < 0.03
    assert receiver.counts.disordered_samples <= 12  # 50 ms until it is believed
    assert receiver._previous is not None and receiver._previous[1] > began_s + 0.25


def test_one_sample_that_is_no_number_leaves_no_angle():
    clock, sensor, receiver = made()
    run(clock, sensor, receiver, 0.5)
    sensor.nan = True
    receiver.take(sensor.block(1))
    assert receiver.angle_around(0.1) is None


def test_blocks_longer_than_half_of_a_small_counter_are_unwrapped():
    """148 frames at once after a standstill, of a cell that counts to 256."""
    unwrapper = CounterUnwrapper(256)
    true = 40 + np.arange(500)
    got = [unwrapper.unwrap(true[part] % 256) for part in (slice(0, 30), slice(30, 178), slice(178, 500))]
    assert np.array_equal(np.concatenate([counter for counter, *_ in got]), true)
    assert all(keep.all() for _, keep, *_ in got)


class Flaky:
    """A sensor for the thread: gone, silent, or giving one sample a reading."""

    sample_rate_hz, counter_modulus = 200.0, 65536
    scale, of_the_cell, on_the_cells_bus = AngleScale(), False, False

    def __init__(self, clock: VirtualClock) -> None:
        self.clock, self.sensor = clock, FakeSensor(clock)
        self.gone, self.silent, self.repeats = True, False, False
        self.opened = self.closed = 0
        self.failing: Exception | None = None

    def open(self) -> dict[str, Any]:
        if self.gone:
            raise DeviceError("angle sensor: no adapter")
        self.opened += 1
        return {"device": "flaky"}

    def read(self, timeout_s: float) -> AngleBlock:
        self.clock.advance(timeout_s)
        if self.failing is not None:
            raise self.failing
        self.sensor.repeating = self.repeats
        return self.sensor.block(0 if self.silent else 1)

    def close(self) -> None:
        self.closed += 1


class Waits(threading.Event):
    """Stands for the pause between two attempts: does what the test says, then goes on; ends after the last."""

    def __init__(self, *steps: Any) -> None:
        super().__init__()
        self.steps, self.waited_s = list(steps), []

    def wait(self, timeout: float | None = None) -> bool:
        self.waited_s.append(timeout)
        if self.steps:
            self.steps.pop(0)()
        else:
            self.set()
        return self.is_set()


def run_thread(device: Flaky, *steps: Any) -> tuple[AngleReceiver, list[Any]]:
    """Run the receiver's thread function here, with these steps in its pauses."""
    receiver = AngleReceiver(device, device.clock)
    receiver._closing = waits = Waits(*steps)
    receiver._run()
    return receiver, waits.waited_s


def test_a_missing_sensor_is_tried_again_and_told():
    device, seen = Flaky(VirtualClock()), []

    def appears() -> None:
        seen.append(receiver.problem)
        device.gone = False
        device.failing = DeviceError("angle sensor on x: the bus was lost: gone")

    receiver = AngleReceiver(device, device.clock)
    receiver._closing = waits = Waits(appears)
    receiver._run()
    assert seen == ["angle sensor: no adapter"]
    assert waits.waited_s == [REOPEN_S, REOPEN_S] and device.opened == 1
    assert "the bus was lost" in receiver.problem


@pytest.mark.parametrize("how", ["silent", "repeats"])
def test_silence_is_told_and_ends_when_an_angle_comes(how: str):
    device = Flaky(VirtualClock())
    device.gone = False
    setattr(device, how, True)
    problems: list[str] = []
    receiver = AngleReceiver(device, device.clock)
    began_s = device.clock.now_s()

    def comes() -> None:
        problems.append(receiver.problem)
        assert device.clock.now_s() - began_s == pytest.approx(SILENCE_S, abs=0.1)
        setattr(device, how, False)
        device.sensor.counter += 1
        receiver.take(device.sensor.block(1))
        problems.append(receiver.problem)
        device.failing = DeviceError("angle sensor: over")

    receiver._closing = Waits(comes)
    receiver._run()
    assert problems == ["angle sensor: silent for 1 s; check its cable and supply", ""]
    assert device.closed == 3  # when silent, when gone, and at the end of its thread


def test_an_adapter_that_opens_while_the_rig_disconnects_is_closed(monkeypatch: pytest.MonkeyPatch):
    _, sensor, receiver = made()
    done: list[str] = []

    def slowly() -> dict[str, Any]:
        receiver._closing.set()  # who closed waits no longer
        done.append("opened")
        return {}

    monkeypatch.setattr(sensor, "open", slowly)
    monkeypatch.setattr(sensor, "close", lambda: done.append("closed"))
    receiver._run()
    assert done == ["opened", "closed"]


def test_a_mistake_in_a_driver_is_told_too():
    device = Flaky(VirtualClock())
    device.gone, device.failing = False, ZeroDivisionError("oh")
    receiver, _ = run_thread(device)
    assert "internal: ZeroDivisionError" in receiver.problem

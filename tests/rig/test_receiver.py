"""The receiver: counters that wrap, samples lost, repeated and late."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig.rig.acquire.receiver import Receiver
from stimrig.rig.acquire.stream import LONGEST_READ_S, LOOK_S, SILENCE_S, CounterUnwrapper
from stimrig.rig.signals import SAMPLE, Block
from tests.rig.fakes import RATE_HZ, FakeCell, FakeStimulator, journal_at
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
    receiver.take(block([1, 2, 5]))
    receiver.begin(tmp_path / "j")
    receiver.take(block([6, 9, 9, 8, 10]))
    counts = receiver.release()
    assert counts.samples == 3  # 6, 9, 10
    assert counts.lost_samples == 2  # 7 and 8: the 8 that came late has no place any more
    assert (counts.duplicate_samples, counts.disordered_samples) == (1, 1)
    assert (counts.malformed_frames, counts.error_frames) == (1, 2)


def test_what_is_told_of_the_newest_sample():
    receiver = Heard()
    clock = receiver.machine.clock
    assert receiver.age_s(clock.now_s()) == np.inf
    assert receiver.torque_around(1.0) is None
    receiver.take(block([1, 2], torque_nm=3.5))
    clock.advance(0.25)
    assert receiver.age_s(clock.now_s()) == 0.25
    assert receiver.torque_around(1.0) == 3.5
    assert receiver.last_torque_nm == 3.5


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
            receiver.take(part)
        means_nm = torque_nm[:992].reshape(-1, 16).mean(axis=1)  # 10 ms at 1600 samples/s
        assert receiver.range_nm == pytest.approx((means_nm.min(), means_nm.max()))


def test_every_sample_of_a_slow_cell_counts_for_the_range(tmp_path: Path):
    receiver = Heard(rate_hz=10.0)
    receiver.begin(tmp_path / "j")
    receiver.take(block([1], torque_nm=1.0))
    receiver.take(block([2], torque_nm=3.0))
    assert receiver.range_nm == (1.0, 3.0)


def test_a_cell_is_silent_after_a_second_of_reading_not_of_standing_still():
    receiver = Heard()
    clock = receiver.machine.clock
    receiver.machine.run(receiver.open())
    began_s = clock.now_s()
    clock.call_at(began_s + 0.01, lambda: clock.advance(2 * SILENCE_S))
    assert clock.run(receiver.machine.tasks, began_s + 60.0, lambda: bool(receiver.lost))
    assert receiver.lost == ["load cell: silent for 1 s; check its cable and supply"]
    read_s = clock.now_s() - began_s - 2 * SILENCE_S
    assert SILENCE_S - LONGEST_READ_S < read_s < SILENCE_S - LONGEST_READ_S + 2 * LOOK_S
    assert receiver.cell.silent, "it was closed"
    assert not receiver.living

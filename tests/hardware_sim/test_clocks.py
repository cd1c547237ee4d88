"""The cell's clock: drift, jitter of its samples, jitter of their delivery, several samples a frame."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from stimrig.hardware_sim.load_cells.cells import Counts, Plain
from stimrig.hardware_sim.load_cells.frames import Sample
from stimrig.hardware_sim.load_cells.sampler import LoadCell
from tests.hardware_sim.test_load_cells import cell

RATE_HZ = 1600.0
PERIOD_S = 1 / RATE_HZ
PACKED = struct.Struct("<hhhH")


def recorded(made: LoadCell, until_s: float) -> tuple[np.ndarray, np.ndarray]:
    """True times (the muscle's torque is the time) and stamps, s."""
    made.produce(until_s)
    frames = made.take_frames()
    times_s = [struct.unpack("<fHBB", frame.data)[0] for frame in frames]
    return np.array(times_s), np.array([1e-6 * frame.time_us for frame in frames])


def test_jitter_moves_each_sample_and_none_overtakes() -> None:
    times_s, stamps_s = recorded(cell(clock_jitter_us=100.0), 4.0)
    off_s = times_s - PERIOD_S * np.arange(times_s.size)
    assert off_s.std() == pytest.approx(100e-6, rel=0.05)
    assert abs(off_s.mean()) < 5e-6
    assert np.allclose(stamps_s, times_s, atol=2e-6)
    assert abs(np.corrcoef(off_s[1:], off_s[:-1])[0, 1]) < 0.05
    wild_s, _ = recorded(cell(clock_jitter_us=10_000.0), 4.0)
    assert np.diff(wild_s).min() > 0.05 * PERIOD_S
    assert wild_s.size == pytest.approx(6400, abs=1)


def test_jitter_can_be_switched_and_leaves_the_grid_where_it_was() -> None:
    made = cell()
    recorded(made, 1.0)
    made.clock.set_jitter(100e-6)
    made.clock.set_rate_factor(1.0)  # a new anchor takes no jitter over
    recorded(made, 2.0)
    made.clock.set_jitter(0.0)
    recorded(made, 2.01)
    times_s, _ = recorded(made, 3.0)
    off_s = (times_s + PERIOD_S / 2) % PERIOD_S - PERIOD_S / 2
    assert np.abs(off_s).max() < 1e-6


@pytest.mark.parametrize("jitter_us", [0.0, 50.0])
def test_three_samples_a_frame(jitter_us: float) -> None:
    made = cell(samples_per_frame=3, clock_jitter_us=jitter_us)
    made.counter = 3 * 65534
    made.produce(2.0)
    frames = made.take_frames()
    rows = [PACKED.unpack(frame.data) for frame in frames]
    assert [row[3] for row in rows[:4]] == [65534, 65535, 0, 1]
    values = np.array([row[:3] for row in rows]).ravel() / 500
    assert values == pytest.approx(PERIOD_S * np.arange(values.size), abs=1e-3 + 3 * 50e-6)
    last_s = np.array([frame.time_us for frame in frames]) * 1e-6
    assert last_s == pytest.approx(PERIOD_S * (3 * np.arange(len(frames)) + 2), abs=1e-6 if not jitter_us else 3e-4)


def test_packed_values_have_stops_and_a_counter_jump_shows() -> None:
    def frame(*torques_nm: float, counter: int = 0) -> tuple[int, ...]:
        samples = [Sample(t, counter + k, True, 0) for k, t in enumerate(torques_nm)]
        return PACKED.unpack(Plain(3).encode(samples).data)

    assert frame(1.0, -70.0, 70.0) == (500, -32767, 32767, 0)
    assert frame(math.nan, 0.001, 0.0, counter=1003) == (-32767, 0, 0, 335)
    assert Counts(2).encode([Sample(50.0, 0, False, 1), Sample(-60.0, 1, False, 2)])[1:3] == (b"\xff\xff\0\0", 2)

"""Each fault of the angle sensor, as its frames show it; on a clock that the test moves."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from stimrig.hardware_sim.errors import FaultError
from stimrig.hardware_sim.faults import library
from tests.hardware_sim.virtual_host import LAYOUT, VirtualHost

ANGLE_FAULTS = sorted(name for name in library() if name.startswith("angle_"))


Row = tuple[float, int, int, int]
Rows = list[Row]
NOISY = pytest.approx(3.0 * math.sqrt(2.0), rel=0.1)


class Bench(VirtualHost):
    """A host of an arm whose angle rises by 5 degrees a second from 60 on; its sensor shows 10 more."""

    def __init__(self, **where: str) -> None:
        super().__init__("held", **where, angle_offset_deg=10.0, angle_noise_deg=0.0, angle_bits=20)
        self.faults, self.encoder = self.devices.faults, self.devices.encoder
        self.encoder._angle_deg = lambda time_s: 60.0 + 5.0 * time_s

    def rows(self, seconds: float = 1.0) -> Rows:
        """The angle sensor's next frames."""
        return [LAYOUT.unpack(frame.data) for frame in self.frames(seconds) if frame.can_id == 0x182]

    def broken(self, name: str, seconds: float = 1.0, **settings: Any) -> Rows:
        """The next frames with this fault; it is off afterwards."""
        self.faults.on(name, settings)
        rows = self.rows(seconds)
        self.faults.off(name)
        return rows


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    made.rows(0.1)
    return made


def angles(rows: Rows) -> np.ndarray:
    return np.array([row[0] for row in rows])


def steps(rows: Rows) -> set[int]:
    return {(after[1] - before[1]) & 0xFFFF for before, after in pairwise(rows)}


@pytest.mark.parametrize("name", ANGLE_FAULTS)
def test_each_ends_without_a_trace_in_the_readings(bench: Bench, name: str) -> None:
    bench.broken(name, 0.5)
    rows = bench.rows(0.5)
    assert len(rows) == pytest.approx(100, abs=1)
    assert steps(rows) == {1}
    assert {row[2] for row in rows} == {0}
    assert angles(rows) == pytest.approx(70.0 + 5.0 * (0.6 + 0.005 * np.arange(len(rows))), abs=0.05)


def jumps(rows: Rows, _: Row) -> bool:
    """Of single readings."""
    off_deg = np.diff(angles(rows))
    return set(np.round(off_deg / 15.0)) >= {-1.0, 0.0, 1.0} and 0.05 < np.mean(np.abs(off_deg) > 7.0) < 0.15


def turned(rows: Rows, last: Row) -> bool:
    """From where it is: no jump gives it away."""
    slope_deg_s = np.polyfit(0.005 * np.arange(len(rows)), angles(rows), 1)[0]
    return rows[0][0] == pytest.approx(last[0], abs=0.1) and slope_deg_s == pytest.approx(-5.0, rel=0.01)


SHOWN: list[tuple[str, float, dict[str, Any], Callable[[Rows, Row], Any]]] = [
    ("stuck", 1.0, {}, lambda rows, _: len(set(angles(rows))) == 1 and steps(rows) == {1}),
    ("jump", 5.0, {"step_deg": 15.0, "probability": 0.05}, jumps),
    ("nan", 1.0, {}, lambda rows, _: np.isnan(angles(rows)).all()),
    ("nan", 1.0, {"probability": 0.3}, lambda rows, _: 0.2 < np.isnan(angles(rows)).mean() < 0.4),
    ("offset_step", 1.0, {"step_deg": 7.0}, lambda rows, last: rows[0][0] == pytest.approx(last[0] + 7.0, abs=0.05)),
    ("reversed", 1.0, {}, turned),
    ("reversed", 0.1, {"about_present": False}, lambda rows, _: np.all(angles(rows) - 10.0 < -60.0)),
    ("noise_burst", 5.0, {"sd_deg": 3.0}, lambda rows, _: np.diff(angles(rows)).std() == NOISY),
    ("fault_bit", 1.0, {}, lambda rows, _: {row[2] for row in rows} == {1} and rows[-1][0] > rows[0][0]),
    ("frames_lost", 10.0, {}, lambda rows, _: steps(rows) >= {1, 2} and len(rows) == pytest.approx(1800, abs=50)),
    ("frames_repeated", 5.0, {}, lambda rows, _: steps(rows) == {0, 1}),
    ("counter_jump", 1.0, {"step": 500}, lambda rows, last: rows[0][1] == last[1] + 501),
    ("rate_off", 10.0, {"percent": -8.0}, lambda rows, _: len(rows) == pytest.approx(1840, abs=2)),
]
"""A fault, for how long, its settings, and what its frames must show after the last one before it."""


@pytest.mark.parametrize(
    ("name", "seconds", "settings", "shows"), SHOWN, ids=[f"{name} {more}" for name, _, more, _ in SHOWN]
)
def test_it_shows(bench: Bench, name: str, seconds: float, settings: dict[str, Any], shows: Callable[[Rows, Row], Any]):
    last = bench.rows(0.1)[-1]
    rows = bench.broken(f"angle_{name}", seconds, **settings)
    assert shows(rows, last), rows[:20]


def test_silent_and_unplugged_differ_in_the_counter(bench: Bench) -> None:
    before = bench.rows(0.1)[-1][1]
    assert bench.broken("angle_silent") == []
    assert bench.rows(0.01)[0][1] == before + 201
    bench.faults.on("angle_unplugged", {})
    frames = bench.frames(1.0)
    bench.faults.off("angle_unplugged")
    assert {frame.can_id for frame in frames} == {0x181}
    assert bench.rows(0.01)[0][1] == 0


def test_delayed_by_what_was_asked_and_stamped_as_if_not(bench: Bench) -> None:
    now = bench.devices.timeline.now_s
    rows = bench.broken("angle_delayed", 1.0, delay_s=0.2)
    late_deg = 70.0 + 5.0 * (now + 0.005 * np.arange(len(rows))) - angles(rows)
    assert late_deg[-1] == pytest.approx(1.0, abs=0.03)
    assert steps(rows) == {1}


def test_a_fault_of_the_bus_takes_both(bench: Bench) -> None:
    bench.faults.on("bus_off", {})
    assert [frame.error for frame in bench.frames()] == [True]
    bench.faults.off("bus_off")
    bench.faults.on("delivery_jitter", {"largest_s": 0.05})
    frames = [frame for _ in range(400) for frame in bench.frames(0.0025)]
    bench.faults.off("delivery_jitter")
    for can_id, fewest in ((0x181, 1400), (0x182, 170)):
        counters = [LAYOUT.unpack(frame.data)[1] for frame in frames if frame.can_id == can_id]
        assert len(counters) > fewest
        assert {(after - before) & 0xFFFF for before, after in pairwise(counters)} == {1}


def test_in_the_cells_frame_readings_fail_and_frames_are_the_cells() -> None:
    bench = Bench(angle="in-cell", cell="with_angle")
    bench.faults.on("angle_nan", {})
    bench.faults.on("angle_fault_bit", {})
    rows = [struct.unpack("<fhBB", frame.data) for frame in bench.frames(0.1)]
    assert {(row[1], row[3]) for row in rows} == {(-32768, 2)}
    with pytest.raises(FaultError, match="use the load cell's fault"):
        bench.faults.on("angle_silent", {})


def test_nonsense_is_told(bench: Bench) -> None:
    for name, settings in {"angle_delayed": {"delay_s": math.nan}, "angle_rate_off": {"percent": -100.0}}.items():
        with pytest.raises(FaultError, match=name):
            bench.faults.on(name, settings)
    bench = VirtualHost()
    for name in ANGLE_FAULTS:
        with pytest.raises(FaultError, match="start it with --arm"):
            bench.devices.faults.on(name, {})

"""Cells of angle and velocity: which are asked for, when one is seen, what is missing, when it is enough."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from stimrig.api.sessions.coverage import ENOUGH, Coverage, covered, grid

RATE_HZ = 200.0
RANGE_RAD = (math.radians(20), math.radians(110))
Sample = tuple[float, float, float]


def sweep(speed_rad_s: float, times: int, begin_s: float = 0.0) -> Iterator[Sample]:
    """From end to end of the range and back, at one speed."""
    low, high = RANGE_RAD[0] + 0.01, RANGE_RAD[1] - 0.01
    time_s = begin_s
    for _ in range(times):
        for start, end in ((low, high), (high, low)):
            count = round(abs(end - start) / speed_rad_s * RATE_HZ)
            for k in range(count):
                yield time_s, start + (end - start) * k / count, math.copysign(speed_rad_s, end - start)
                time_s += 1 / RATE_HZ


def moved(*speeds: float, seen_s: float = 0.2) -> Coverage:
    found, time_s = Coverage(grid(RANGE_RAD, seen_s)), 0.0
    for speed in speeds:
        for sample in sweep(speed, 2, time_s):
            found.add(*sample)
            time_s = sample[0] + 1 / RATE_HZ
    return found


def test_columns_lie_within_the_range() -> None:
    cells = grid(RANGE_RAD, 0.2)
    assert cells.columns == 5
    assert RANGE_RAD[0] < cells.angle_rad[0] < cells.angle_rad[-1] < RANGE_RAD[1]
    assert [grid((0.0, width), 0.2).columns for width in (0.3, 0.9, 6.0)] == [3, 3, 8]


def test_slow_alone_leaves_the_fast_ones_missing() -> None:
    found = moved(0.4)
    assert not found.enough and 0.4 < found.share < ENOUGH
    assert {each.speed for each in found.missing()} == {"fast"}
    assert {each.direction for each in found.missing()} == {"flexion", "extension"}


def test_slow_and_fast_is_enough() -> None:
    found = moved(0.4, 1.2)
    assert found.share == 1.0 and found.enough and found.missing() == []


def test_a_small_movement_misses_the_ends_in_one_stretch_each() -> None:
    found = Coverage(grid(RANGE_RAD, 0.2))
    middle = sum(RANGE_RAD) / 2
    for k in range(4000):
        found.add(k / RATE_HZ, middle + 0.1 * math.sin(4 * k / RATE_HZ), 0.4 * math.cos(4 * k / RATE_HZ))
    slow = [each for each in found.missing() if (each.direction, each.speed) == ("flexion", "slow")]
    assert len(slow) == 2 and slow[0].to_rad <= middle <= slow[1].from_rad
    assert found.missing()[0].speed == "slow", "what is to be done first comes first"


def test_a_still_joint_shows_nothing() -> None:
    found = Coverage(grid(RANGE_RAD, 0.2))
    for k in range(2000):
        found.add(k / RATE_HZ, 1.0, 0.0)
    assert found.share == 0.0


def test_a_cell_is_seen_after_its_time_and_not_before() -> None:
    found = Coverage(grid(RANGE_RAD, 0.2))
    row, column = found.grid.cell(1.0, 0.4)
    for k in range(40):
        found.add(k / RATE_HZ, 1.0, 0.4)
    assert not found.seen(row, column)
    found.add(40 / RATE_HZ, 1.0, 0.4)
    assert found.seen(row, column)


@pytest.mark.parametrize(
    "odd",
    [(math.nan, 1.0, 0.4), (0.01, math.nan, 0.4), (0.01, 1.0, math.inf), (-5.0, 1.0, 0.4), (9.0, 1.0, 0.4)],
)
def test_no_number_a_gap_or_a_step_back_counts_for_nothing(odd: Sample) -> None:
    found = Coverage(grid(RANGE_RAD, 0.2))
    found.add(0.0, 1.0, 0.4)
    found.add(*odd)
    assert found.share == 0.0 and sum(map(sum, found.time_s)) == 0.0


def test_what_does_not_count_is_passed_over() -> None:
    """Under stimulation only: the pauses between two levels say nothing of the muscle."""
    samples = list(sweep(0.4, 2)) + list(sweep(1.2, 2, 20.0))
    columns = list(zip(*samples, strict=True))
    cells = grid(RANGE_RAD, 0.1)
    assert covered(cells, *columns).enough
    assert covered(cells, *columns, counts=[False] * len(samples)).share == 0.0
    only_flexion = covered(cells, *columns, counts=[velocity > 0 for _, _, velocity in samples])
    assert {each.direction for each in only_flexion.missing()} == {"extension"}


def test_the_document_says_it_all() -> None:
    told = moved(0.4).document()
    columns = len(told["angle_edges_rad"]) - 1
    assert [len(row) for row in told["time_s"]] == [columns] * 5 == [len(row) for row in told["asked"]]
    assert len(told["velocity_edges_rad_s"]) == 4 and 0 < told["share"] < 1 and not told["enough"]
    assert set(told["missing"][0]) == {"direction", "speed", "from_rad", "to_rad"}

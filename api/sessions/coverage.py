"""How much of a joint's angles and velocities a movement has shown, and what is still missing. Pure: samples in.

The range is cut into cells of angle and velocity: fast and slow in both directions, and nearly still. A cell is seen
once the joint was in it for long enough. Nearly still is not asked for, nor fast at the ends of the range, where a
movement turns round.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

SLOW_RAD_S, FAST_RAD_S = 0.15, 0.7
"""A movement slower than the first is none; from the second on it is a fast one (40°/s)."""
VELOCITY_EDGES_RAD_S = (-FAST_RAD_S, -SLOW_RAD_S, SLOW_RAD_S, FAST_RAD_S)
ROWS = (("extension", "fast"), ("extension", "slow"), None, ("flexion", "slow"), ("flexion", "fast"))
"""What each row of velocities is: direction and speed; None: nearly still."""
BIN_RAD = math.radians(15)
LEAST_BINS, MOST_BINS = 3, 8
MARGIN_RAD, MARGIN_SHARE = math.radians(3), 0.05
"""Left out at each end of the range: whoever leaves the range ends the test."""
LONGEST_STEP_S = 0.05
"""A longer gap between two samples says nothing of the cells between them."""
ENOUGH = 0.9
"""Share of the cells that are asked for."""


@dataclass(frozen=True)
class Grid:
    """The cells.

    Parameters
    ----------
    angle_rad : tuple of float
        Edges of the A columns, rad, rising; angles beyond belong to the outer columns.
    seen_s : float
        Time in a cell after which it is seen, s.
    """

    angle_rad: tuple[float, ...]
    seen_s: float

    @property
    def columns(self) -> int:
        """How many bins of angle."""
        return len(self.angle_rad) - 1

    def asked(self, row: int, column: int) -> bool:
        """Whether a cell is asked for."""
        kind = ROWS[row]
        return kind is not None and (kind[1] == "slow" or 0 < column < self.columns - 1)

    def cell(self, angle_rad: float, velocity_rad_s: float) -> tuple[int, int]:
        """Row and column of a sample."""
        column = min(max(bisect_right(self.angle_rad, angle_rad) - 1, 0), self.columns - 1)
        return bisect_right(VELOCITY_EDGES_RAD_S, velocity_rad_s), column


@dataclass(frozen=True)
class Missing:
    """A stretch of angles that was not seen yet in one direction and at one speed."""

    direction: str
    speed: str
    from_rad: float
    to_rad: float


def grid(range_rad: Sequence[float], seen_s: float) -> Grid:
    """The cells for a range of angles (lowest, highest, rad): columns of about 15°, from 3 to 8 of them."""
    low, high = range_rad
    margin = max(MARGIN_RAD, MARGIN_SHARE * (high - low))
    first, last = (low + margin, high - margin) if high - low > 4 * margin else (low, high)
    count = min(max(round((last - first) / BIN_RAD), LEAST_BINS), MOST_BINS)
    return Grid(tuple(first + (last - first) * k / count for k in range(count + 1)), seen_s)


class Coverage:
    """What was seen of a grid; grows sample by sample."""

    def __init__(self, cells: Grid) -> None:
        self.grid = cells
        self.time_s = [[0.0] * cells.columns for _ in ROWS]
        self._last_s: float | None = None

    def add(self, time_s: float, angle_rad: float, velocity_rad_s: float, counts: bool = True) -> None:
        """Take a sample; one that does not count (no stimulation, say) only moves the time on.

        A sample that is no number is left out.
        """
        if not math.isfinite(time_s + angle_rad + velocity_rad_s):
            return
        last_s, self._last_s = self._last_s, time_s
        if not counts or last_s is None or not (0.0 < time_s - last_s <= LONGEST_STEP_S):
            return
        row, column = self.grid.cell(angle_rad, velocity_rad_s)
        self.time_s[row][column] += time_s - last_s

    def seen(self, row: int, column: int) -> bool:
        """Whether the joint was in a cell for long enough; a hair less, for sums of samples."""
        return self.time_s[row][column] >= self.grid.seen_s - 1e-6

    @property
    def share(self) -> float:
        """Share of the cells that are asked for which were seen, 0 to 1."""
        asked = [(row, column) for row, column in self._cells() if self.grid.asked(row, column)]
        return sum(self.seen(*cell) for cell in asked) / len(asked)

    @property
    def enough(self) -> bool:
        """Whether a test may end: at most a tenth is missing."""
        return self.share >= ENOUGH - 1e-9

    def missing(self) -> list[Missing]:
        """What was not seen yet, neighbours taken together: slow before fast, as it is to be done."""
        found = []
        for row in sorted(range(len(ROWS)), key=_order):
            kind = ROWS[row]
            open_ones = [k for k in range(self.grid.columns) if self.grid.asked(row, k) and not self.seen(row, k)]
            for first, last in _runs(open_ones):
                assert kind is not None
                found.append(Missing(*kind, self.grid.angle_rad[first], self.grid.angle_rad[last + 1]))
        return found

    def document(self) -> dict[str, Any]:
        """As clients see it."""
        return {
            "angle_edges_rad": [round(edge, 4) for edge in self.grid.angle_rad],
            "velocity_edges_rad_s": list(VELOCITY_EDGES_RAD_S),
            "time_s": [[round(value, 3) for value in row] for row in self.time_s],
            "asked": [[self.grid.asked(row, k) for k in range(self.grid.columns)] for row in range(len(ROWS))],
            "seen_s": self.grid.seen_s,
            "share": round(self.share, 4),
            "enough": self.enough,
            "missing": [dict(vars(each)) for each in self.missing()],
        }

    def _cells(self) -> Iterable[tuple[int, int]]:
        return ((row, column) for row in range(len(ROWS)) for column in range(self.grid.columns))


def covered(
    cells: Grid, time_s: Sequence[float], angle_rad: Sequence[float], velocity_rad_s: Sequence[float],
    counts: Sequence[bool] | None = None,
) -> Coverage:  # fmt: skip
    """What a whole record shows.

    Parameters
    ----------
    cells : Grid
        The cells.
    time_s, angle_rad, velocity_rad_s : sequence of float, shape (N,)
        The samples, s, rad, rad/s.
    counts : sequence of bool, shape (N,), optional
        Which of them count; None: all.
    """
    found = Coverage(cells)
    flags = [True] * len(time_s) if counts is None else counts
    for sample in zip(time_s, angle_rad, velocity_rad_s, flags, strict=True):
        found.add(*sample)
    return found


def _order(row: int) -> tuple[bool, int]:
    kind = ROWS[row]
    return (kind is not None and kind[1] == "fast", -row)


def _runs(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """First and last of each run of neighbours."""
    runs: list[tuple[int, int]] = []
    for number in numbers:
        if runs and runs[-1][1] == number - 1:
            runs[-1] = (runs[-1][0], number)
        else:
            runs.append((number, number))
    return runs

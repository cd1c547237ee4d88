"""One record with one recruitment basis: the linear problem for given dynamics, and its solution."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from stimrig.identify.dynamics.boundary import held_states
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.dynamics.mean_weights import read_means
from stimrig.identify.dynamics.pulse_grid import Grid
from stimrig.identify.dynamics.second_order import Core, step_matrix
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.recruitment.curve import Basis
from stimrig.identify.recruitment.smoothing import straight_lines

INITIAL_RIDGE = 1e-8
"""Penalty on the initial torque: it keeps a state that no row shows at zero, and is negligible for all others."""
RATE_S = 0.1
"""The penalty on an initial rate is that on the torque rate × RATE_S."""


@dataclass
class Projection:
    """One record and one basis: all that does not change while the dynamics are searched.

    Parameters
    ----------
    grid : Grid
        The record on the grid of pulses.
    basis : Basis
        Basis of the recruitment curve.
    roughness : ndarray, shape (P, P)
        Penalty on the coefficients.
    rows : ndarray of bool, shape (K,)
        Rows that are fitted.
    delay_s : float or None
        A fixed delay; None to estimate it.
    """

    grid: Grid
    basis: Basis
    roughness: np.ndarray
    rows: np.ndarray
    delay_s: float | None = None
    stretches: list[slice] = field(init=False)

    def __post_init__(self) -> None:
        self.stretches = self.grid.stretches(self.rows)
        if not self.stretches:
            raise NotIdentifiable("no row may be fitted", fix="Give rows outside `validate`.")

    @cached_property
    def rows_nm(self) -> np.ndarray:
        """Held drive of each interval, one row per coefficient: basis functions, then zeros for the initial states."""
        widths, place = np.unique(self.grid.pulse_width_us, return_inverse=True)
        rows = np.zeros((self.basis.size + 2 * self.grid.starts.size, self.grid.size))
        rows[: self.basis.size] = self.grid.held(self.basis.design(widths)[place].T, axis=1)
        return rows

    @cached_property
    def beginnings(self) -> np.ndarray:
        """Initial states of each row: zero for the basis functions, then unit torques and unit rates."""
        found = np.zeros((len(self.rows_nm), self.grid.starts.size, 2))
        for number in range(self.grid.starts.size):
            found[self.basis.size + 2 * number :, number][:2] = np.eye(2)
        return found

    @cached_property
    def levels(self) -> np.ndarray:
        """Columns of the baselines, one per part, shape (K, B)."""
        return (self.grid.part[:, None] == np.arange(self.grid.begins.size)).astype(float)

    @cached_property
    def null(self) -> int:
        """Dimension of the curves without penalty."""
        return straight_lines(self.roughness)

    @cached_property
    def target(self) -> np.ndarray:
        """Torque, with zeros where there is none (such rows are never fitted)."""
        return np.nan_to_num(self.grid.torque_nm)

    @property
    def extras(self) -> int:
        """Number of linear columns besides recruitment: baselines, and torque and rate of each initial state."""
        return self.grid.begins.size + 2 * self.grid.starts.size

    @cached_property
    def ridge(self) -> np.ndarray:
        """Penalty on baselines (0) and initial states (very small)."""
        states = np.tile([1.0, RATE_S**2], self.grid.starts.size)
        return INITIAL_RIDGE * np.r_[np.zeros(self.grid.begins.size), states]

    def columns(self, linear: SecondOrder) -> np.ndarray:
        """Interval means of the response to each linear coefficient, shape (K, P + extras)."""
        even = np.tile(step_matrix(*linear.core, self.grid.step_s), (len(self.rows_nm), 1))
        torque, rate = held_states(self.rows_nm, even, self.grid.starts, self.beginnings)
        rows = read_means(torque, rate, *self.grid.mean_weights(linear.delay_s, self.grid.curve(linear.core)))
        size = self.basis.size
        return np.concatenate([rows[:size], self.levels.T, rows[size:]]).T

    @property
    def searched(self) -> int:
        """Number of searched parameters of the dynamics."""
        return 3 if self.delay_s is None else 2

    def slopes(self, linear: SecondOrder, coefficients: np.ndarray) -> np.ndarray:
        """Derivatives of the interval means by log T, log ζ and (if searched) the delay, shape (K, 2 or 3)."""
        step, size, grid = 1e-6, self.basis.size, self.grid
        t, z, d = linear.time_constant_s, linear.damping, linear.delay_s
        drive = coefficients[:size] @ self.rows_nm[:size]
        begin = coefficients[size + grid.begins.size :].reshape(1, -1, 2)
        near: list[Core] = [(t, z), (t * np.exp(step), z), (t, z * np.exp(step))]
        even = np.array([step_matrix(*core, grid.step_s) for core in near])
        exact = grid.curve(near[0])
        torque, rate = held_states(np.tile(drive, (3, 1)), even, grid.starts, np.tile(begin, (3, 1, 1)))

        def read(row: int, delay_s: float) -> np.ndarray:
            at = slice(row, row + 1)
            return read_means(torque[at], rate[at], *grid.mean_weights(delay_s, exact and near[row]))[0]

        mean = [read(row, d) for row in range(3)]
        change = [mean[1] - mean[0], mean[2] - mean[0]]
        if self.delay_s is None:
            # The delay only shifts the places at which the curve is read.
            change.append(read(0, d + step) - mean[0])
        return np.stack(change).T / step


@dataclass(frozen=True)
class Solution:
    """The result of a search.

    Parameters
    ----------
    projection : Projection
        Record and basis.
    linear : SecondOrder
        Dynamics.
    coefficients : ndarray, shape (P + extras,)
        Recruitment, baseline, initial state.
    weight : float
        Weight of the roughness penalty.
    ar1 : float
        Correlation of the noise, with which rows were whitened.
    columns, slopes : ndarray, shape (K, P + extras), (K, 2 or 3)
        Derivatives of the interval means by the coefficients and by the searched parameters.
    freedom : float
        Effective number of coefficients in all.
    variance : float
        Innovation variance on the grid, N²m².
    """

    projection: Projection
    linear: SecondOrder
    coefficients: np.ndarray
    weight: float
    ar1: float
    columns: np.ndarray
    slopes: np.ndarray
    freedom: float
    variance: float

    @cached_property
    def residual_nm(self) -> np.ndarray:
        """Measured minus model on the grid, N·m, shape (K,); meaningful in rows with samples only."""
        return self.projection.target - self.columns @ self.coefficients

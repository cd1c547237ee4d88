"""Variable projection: recruitment in linear coefficients, dynamics in three numbers, one joint estimate.

For given (T, ζ, delay) the model is linear in the recruitment's coefficients, the baseline and the state in which the
record begins. They are solved for exactly; only the three numbers are searched
(Golub & Pereyra 1973, with Kaufman's Jacobian: the Gauss-Newton step of the joint problem).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numba import njit

from identify.dynamics.boundary import held_states
from identify.dynamics.linear import DAMPING_BOUNDS, TIME_CONSTANT_BOUNDS_S, SecondOrder
from identify.dynamics.mean_weights import read_means
from identify.dynamics.pulse_grid import Grid
from identify.dynamics.second_order import Core, step_matrix
from identify.errors import NotIdentifiable
from identify.noise.ar1 import ar1_or_white, whiten
from identify.recruitment.curve import Basis
from identify.recruitment.knots import (
    KNOTS,
    PILOT_KNOTS,
    QUIET_KNOTS,
    adapted_knots,
    bending_order,
    even_knots,
    knots_for,
    spline_roughness,
)
from identify.recruitment.smoothing import choose_weight, straight_lines
from identify.recruitment.spline import SplineBasis

STARTS_S = (0.12, 0.4)
ROUNDING = 2e-5
"""Share of the torque's range below which a residual is not noise."""
QUIET = 0.0015
"""Noise of a sample over the range of torque, below which a spline errs visibly at a bend: it then has more knots."""
INITIAL_RIDGE = 1e-8
"""Of the initial torque: enough for a state that no row sees to stay at rest, too little to be felt by any other."""
RATE_S = 0.1
"""Initial rate times this counts as a torque."""
CURVE_POINTS = 201
REWEIGHTED = 2
"""Steps of a search after which the penalty's weight stays: a moving target has no minimum."""


@dataclass
class Projection:
    """One record, one basis: what doesn't change while the dynamics are searched.

    Parameters
    ----------
    grid : Grid
        The record on the grid of pulses.
    basis : Basis
        Of the recruitment curve.
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
            raise NotIdentifiable("no row may be fitted", mend="Give rows outside `validate`.")

    @cached_property
    def rows_nm(self) -> np.ndarray:
        """Held drive of each interval, row by row: basis functions, then nothing for open states."""
        widths, place = np.unique(self.grid.pulse_width_us, return_inverse=True)
        rows = np.zeros((self.basis.size + 2 * self.grid.starts.size, self.grid.size))
        rows[: self.basis.size] = self.grid.held(self.basis.design(widths)[place].T, axis=1)
        return rows

    @cached_property
    def beginnings(self) -> np.ndarray:
        """State of each row where states are open: the basis functions at rest, then unit torques and rates."""
        found = np.zeros((len(self.rows_nm), self.grid.starts.size, 2))
        for number in range(self.grid.starts.size):
            found[self.basis.size + 2 * number :, number][:2] = np.eye(2)
        return found

    @cached_property
    def levels(self) -> np.ndarray:
        """Baseline of each part, shape (K, B)."""
        return (self.grid.part[:, None] == np.arange(self.grid.begins.size)).astype(float)

    @cached_property
    def null(self) -> int:
        """Dimension of the curves that the penalty leaves alone."""
        return straight_lines(self.roughness)

    @cached_property
    def target(self) -> np.ndarray:
        """Torque, with zeros where there is none (such rows are never fitted)."""
        return np.nan_to_num(self.grid.torque_nm)

    @property
    def extras(self) -> int:
        """Linear columns that aren't recruitment: baselines, and of each open state a torque and its rate."""
        return self.grid.begins.size + 2 * self.grid.starts.size

    @cached_property
    def ridge(self) -> np.ndarray:
        """Penalty on baselines and initial states: a state that no row sees stays at rest."""
        states = np.tile([1.0, RATE_S**2], self.grid.starts.size)
        return INITIAL_RIDGE * np.r_[np.zeros(self.grid.begins.size), states]

    def columns(self, linear: SecondOrder) -> np.ndarray:
        """Block means of the response to each linear coefficient, shape (K, P + extras)."""
        even = np.tile(step_matrix(*linear.core, self.grid.step_s), (len(self.rows_nm), 1))
        torque, rate = held_states(self.rows_nm, even, self.grid.starts, self.beginnings)
        rows = read_means(torque, rate, *self.grid.mean_weights(linear.delay_s, self.grid.curve(linear.core)))
        size = self.basis.size
        return np.concatenate([rows[:size], self.levels.T, rows[size:]]).T

    @property
    def searched(self) -> int:
        """How many numbers of the dynamics are searched."""
        return 3 if self.delay_s is None else 2

    def slopes(self, linear: SecondOrder, coefficients: np.ndarray) -> np.ndarray:
        """Derivatives of the block means by log T, log ζ and (if searched) the delay, shape (K, 2 or 3)."""
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
            # The delay shifts only where the curve is read.
            change.append(read(0, d + step) - mean[0])
        return np.stack(change).T / step


@dataclass(frozen=True)
class Solution:
    """Where a search ended.

    Parameters
    ----------
    problem : Projection
        What was solved.
    linear : SecondOrder
        Dynamics.
    coefficients : ndarray, shape (P + extras,)
        Recruitment, baseline, initial state.
    weight : float
        Of the roughness.
    ar1 : float
        Correlation of the noise that rows were whitened with.
    columns, slopes : ndarray, shape (K, P + extras), (K, 2 or 3)
        The model's derivatives there.
    freedom : float
        Effective number of coefficients in all.
    variance : float
        Innovation variance on the grid, N²m².
    """

    problem: Projection
    linear: SecondOrder
    coefficients: np.ndarray
    weight: float
    ar1: float
    columns: np.ndarray
    slopes: np.ndarray
    freedom: float
    variance: float

    @cached_property
    def fitted_nm(self) -> np.ndarray:
        """Block means of the model, shape (K,)."""
        return self.columns @ self.coefficients

    @cached_property
    def residual_nm(self) -> np.ndarray:
        """Measured less model on the grid, shape (K,); meaningful in rows with samples."""
        return self.problem.target - self.fitted_nm


def search(
    problem: Projection,
    start: SecondOrder,
    *,
    ar1: float = 0.0,
    weight: float | None = None,
    most: int = 25,
    tolerance: float = 0.01,
) -> Solution:
    """Gauss-Newton on the dynamics with the coefficients projected out, damped where a step fails.

    Parameters
    ----------
    problem : Projection
        Record and basis.
    start : SecondOrder
        Where to begin.
    ar1 : float
        Correlation of the noise.
    weight : float, optional
        Of the roughness; None to choose it by REML on the way.
    most : int
        Steps at most.
    tolerance : float
        Converged once a step is this small in standard errors.
    """
    target = whiten(problem.target, problem.stretches, ar1)
    state = _assess(problem, _bounded(problem, start), target, ar1, weight)
    return _descend(state, weight, most, tolerance)


def _descend(state: _State, weight: float | None, most: int, tolerance: float) -> Solution:
    problem, linear, target, ar1 = state.problem, state.linear, state.target, state.ar1
    damping, taken = 0.0, 0
    while taken < most:
        taken += 1
        step = state.step(damping)
        trial = _bounded(problem, _moved(linear, step))
        moved = _difference(linear, trial)[: problem.searched]
        # Steps in units of standard errors, from the information itself.
        size = float(np.sqrt(max(moved @ state.information @ moved, 0.0) * target.size / state.squares))
        if size < tolerance or np.max(np.abs(moved)) < 1e-9:
            break
        keep = None if (weight is None and taken <= REWEIGHTED) else state.weight
        attempt = _assess(problem, trial, target, ar1, keep)
        against = state.cost if keep is not None else state.cost_at(attempt.weight)
        if attempt.cost <= against * (1 + 1e-9):
            linear, state, damping = trial, attempt, damping / 10 if damping > 1e-4 else 0.0
        else:
            damping = max(10 * damping, 1e-2)
            if damping > 1e8:
                break
    return state.solution()


def project(problem: Projection, linear: SecondOrder, *, ar1: float = 0.0, weight: float | None = None) -> Solution:
    """Coefficients for given dynamics: the linear half of the problem alone."""
    return _assess(problem, linear, whiten(problem.target, problem.stretches, ar1), ar1, weight).solution()


class _State:
    """The joint linear problem at one point of the search."""

    def __init__(
        self, problem: Projection, linear: SecondOrder, target: np.ndarray, ar1: float, weight: float | None
    ) -> None:
        self.problem, self.linear, self.target, self.ar1 = problem, linear, target, ar1
        self.columns = problem.columns(linear)
        white = whiten(self.columns, problem.stretches, ar1)
        self.zz, self.zy = white.T @ white, white.T @ target
        self.energy = float(target @ target)
        size = problem.basis.size
        if weight is None:
            weight = self._chosen(size)
        self.weight = weight
        self.penalty = np.zeros_like(self.zz)
        self.penalty[:size, :size] = weight * problem.roughness
        self.penalty[size:, size:] = np.diag(problem.ridge)
        self.coefficients = _solve(self.zz + self.penalty, self.zy)
        self.cost = self.energy - float(self.zy @ self.coefficients)
        self.white = white

    @cached_property
    def slopes(self) -> np.ndarray:
        """Derivatives by the searched numbers, shape (K, 2 or 3)."""
        return self.problem.slopes(self.linear, self.coefficients)

    @cached_property
    def _bent(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        bent = whiten(self.slopes, self.problem.stretches, self.ar1)
        return self.white.T @ bent, bent.T @ bent, bent.T @ self.target

    @cached_property
    def _inner(self) -> np.ndarray:
        return _solve(self.zz + self.penalty, self._bent[0])

    @cached_property
    def information(self) -> np.ndarray:
        """That of the searched numbers, coefficients projected out."""
        cross, square, _ = self._bent
        return square - cross.T @ self._inner

    @cached_property
    def freedom(self) -> float:
        """Effective number of parameters."""
        return float(np.trace(_solve(self.zz + self.penalty, self.zz))) + self.slopes.shape[1]

    @cached_property
    def squares(self) -> float:
        """Sum of squared innovations, not below what rounding leaves."""
        c = self.coefficients
        left = self.energy - 2 * float(self.zy @ c) + float(c @ self.zz @ c)
        return max(left, 1e-14 * self.energy, 1e-24 * self.target.size)

    @cached_property
    def variance(self) -> float:
        """Innovation variance, N²m²."""
        return self.squares / max(self.target.size - self.freedom, 1.0)

    def _chosen(self, size: int) -> float:
        outer = self.zz[size:, size:]
        right = np.concatenate([self.zz[size:, :size], self.zy[size:, None]], axis=1)
        inner = _solve(outer + np.diag(self.problem.ridge), right)
        gram = self.zz[:size, :size] - self.zz[:size, size:] @ inner[:, :-1]
        moment = self.zy[:size] - self.zz[:size, size:] @ inner[:, -1]
        energy = self.energy - float(self.zy[size:] @ inner[:, -1])
        if not np.any(self.problem.roughness):
            return 0.0
        known = {"free": self.problem.extras, "null": self.problem.null}
        size_fitted = self.target.size
        return choose_weight((gram + gram.T) / 2, moment, energy, size_fitted, self.problem.roughness, **known).weight

    def cost_at(self, weight: float) -> float:
        """The penalised cost here under another weight."""
        size = self.problem.basis.size
        other = self.penalty.copy()
        other[:size, :size] = weight * self.problem.roughness
        return self.energy - float(self.zy @ _solve(self.zz + other, self.zy))

    def step(self, damping: float) -> np.ndarray:
        """Step in (log T, log ζ, delay), along the bounds where it would leave them."""
        moment = self._bent[2]
        gradient = moment - self._inner.T @ self.zy
        free = ~_held(self.problem, self.linear, gradient)
        step = np.zeros(gradient.size)
        if free.any():
            information = self.information[np.ix_(free, free)]
            step[free] = _solve(information + damping * np.diag(np.diag(information)), gradient[free])
        return step

    def solution(self) -> Solution:
        return Solution(
            problem=self.problem,
            linear=self.linear,
            coefficients=self.coefficients,
            weight=self.weight,
            ar1=self.ar1,
            columns=self.columns,
            slopes=self.slopes,
            freedom=self.freedom,
            variance=self.variance,
        )


def _assess(problem: Projection, linear: SecondOrder, target: np.ndarray, ar1: float, weight: float | None) -> _State:
    return _State(problem, linear, target, ar1, weight)


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric system, scaled to a unit diagonal, with a hair of ridge against empty columns."""
    solved = _scaled_solve(np.ascontiguousarray(matrix), np.ascontiguousarray(right.reshape(len(right), -1)))
    return solved.reshape(right.shape)


@njit(cache=True, nogil=True)
def _scaled_solve(matrix, right):  # pragma: no cover
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * scale.reshape(-1, 1) * scale
    for i in range(scale.size):
        scaled[i, i] = 1.0 + 1e-12
    return scale.reshape(-1, 1) * np.linalg.solve(scaled, scale.reshape(-1, 1) * right)


def _moved(linear: SecondOrder, step: np.ndarray) -> SecondOrder:
    t, z = np.exp(np.clip(step[:2], -0.7, 0.7))
    delay = float(np.clip(step[2], -0.03, 0.03)) if step.size > 2 else 0.0
    return SecondOrder(linear.time_constant_s * float(t), linear.damping * float(z), linear.delay_s + delay)


def _difference(before: SecondOrder, after: SecondOrder) -> np.ndarray:
    return np.array(
        [
            np.log(after.time_constant_s / before.time_constant_s),
            np.log(after.damping / before.damping),
            after.delay_s - before.delay_s,
        ]
    )


def _held(problem: Projection, linear: SecondOrder, gradient: np.ndarray) -> np.ndarray:
    """Which of the searched numbers stand at a bound and are pulled beyond it."""
    values = np.array([linear.time_constant_s, linear.damping, linear.delay_s])[: gradient.size]
    bounds = np.array([TIME_CONSTANT_BOUNDS_S, DAMPING_BOUNDS, problem.grid.delay_bounds_s])[: gradient.size]
    lower, upper = bounds[:, 0], bounds[:, 1]
    return ((values <= lower) & (gradient < 0)) | ((values >= upper) & (gradient > 0))


def _bounded(problem: Projection, linear: SecondOrder) -> SecondOrder:
    delay = float(np.clip(linear.delay_s, *problem.grid.delay_bounds_s)) if problem.delay_s is None else problem.delay_s
    return SecondOrder(
        float(np.clip(linear.time_constant_s, *TIME_CONSTANT_BOUNDS_S)),
        float(np.clip(linear.damping, *DAMPING_BOUNDS)),
        delay,
    )


def pilot_solution(grid: Grid, rows: np.ndarray, delay_s: float | None = None) -> Solution:
    """A first fit with few knots, from several time constants, the best start taken.

    Raises
    ------
    NotIdentifiable
        The pulse width never changes, or the torque never does.
    """
    largest = float(np.max(grid.pulse_width_us))
    seen = grid.pulse_width_us[rows]
    if not largest > 0 or np.ptp(seen) <= 0:
        raise NotIdentifiable(
            "the pulse width never changes in the rows that are fitted" if largest > 0 else "no pulse is in the record",
            mend="Record a PRBS and a ramp.",
        )
    if np.ptp(grid.torque_nm[rows]) <= 0:
        raise NotIdentifiable("the torque never changes", mend="Check the load cell and the electrodes.")
    basis = SplineBasis(even_knots(largest, PILOT_KNOTS))
    order = bending_order(grid.pulse_width_us[rows])
    problem = Projection(grid, basis, spline_roughness(basis, order=order), rows, delay_s)
    target = whiten(problem.target, problem.stretches, 0.0)
    delay = 0.0 if delay_s is None else delay_s
    starts = [_assess(problem, _bounded(problem, SecondOrder(t, 0.9, delay)), target, 0.0, None) for t in STARTS_S]
    best = min(starts, key=lambda state: state.cost)
    return _descend(best, None, most=12, tolerance=0.5)


def designed(first: Solution, count: int | None = None) -> tuple[Projection, SecondOrder]:
    """The problem with its final spline, in two steps from a pilot, and where to begin its search.

    The pilot's few knots say roughly where the curve bends; a curve with all knots says it better, and how much; a
    second such look sharpens a steep rise.
    """
    old = first.problem
    curve = pilot_curve(first)
    count = knots_for(curve) if count is None else count
    basis = SplineBasis(adapted_knots(curve, float(np.max(old.grid.pulse_width_us)), count))
    order = bending_order(old.grid.pulse_width_us[old.rows])
    problem = Projection(old.grid, basis, spline_roughness(basis, order=order), old.rows, old.delay_s)
    target = whiten(problem.target, problem.stretches, 0.0)
    for _ in range(2):
        coefficients = _assess(problem, first.linear, target, 0.0, None).coefficients[: basis.size]
        problem, basis = _redesigned(problem, basis, coefficients, count)
    return problem, first.linear


def _redesigned(
    old: Projection, basis: SplineBasis, coefficients: np.ndarray, count: int
) -> tuple[Projection, SplineBasis]:
    """The problem with knots and penalty from a first curve."""
    u = np.linspace(0.0, basis.largest_us, CURVE_POINTS)
    new = SplineBasis(adapted_knots((u, basis.design(u) @ coefficients), basis.largest_us, count))
    order = bending_order(old.grid.pulse_width_us[old.rows])
    roughness = spline_roughness(new, (basis, coefficients), order)
    return Projection(old.grid, new, roughness, old.rows, old.delay_s), new


def pilot_curve(solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """The curve of a solution on 201 pulse widths."""
    basis = solution.problem.basis
    u = np.linspace(0.0, basis.largest_us, CURVE_POINTS)
    return u, basis.design(u) @ solution.coefficients[: basis.size]


def estimate(
    grid: Grid, rows: np.ndarray, knots: int | None = None, delay_s: float | None = None
) -> tuple[Solution, float]:
    """The solution, and the evidence for AR(1) over white noise (ΔBIC)."""
    first = pilot_solution(grid, rows, delay_s)
    quiet = 0.0 < grid.noise_sd_nm < QUIET * float(np.ptp(grid.torque_nm[rows]))
    problem, start = designed(first, QUIET_KNOTS if knots is None and quiet else knots)
    solution = search(problem, start)
    ar1, delta_bic = ar1_or_white(solution.residual_nm, problem.stretches)
    if delta_bic > 0 and knots is None and problem.basis.size < KNOTS:
        # Structure may be a bend that few knots can't follow: look again with all before calling it noise.
        problem, start = designed(first, KNOTS)
        solution = search(problem, start)
        ar1, delta_bic = ar1_or_white(solution.residual_nm, problem.stretches)
    # What is left of a record without noise is rounding and the spline's own error: not worth a noise model.
    still = solution.variance < (ROUNDING * float(np.ptp(problem.target[rows]))) ** 2
    for _ in range(0 if still else 3):
        if delta_bic <= 0:
            break
        solution = search(problem, solution.linear, ar1=ar1)
        before = ar1
        ar1, delta_bic = ar1_or_white(solution.residual_nm, problem.stretches)
        if abs(ar1 - before) < 0.01:
            break
    return solution, delta_bic

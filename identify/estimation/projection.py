"""Variable projection: a joint estimate of recruitment and dynamics that searches only three parameters.

For given (T, ζ, delay) the model is linear in the recruitment coefficients, the baseline and the initial state. These
are solved for exactly; only the three parameters are searched (Golub & Pereyra 1973, with the Jacobian of Kaufman: the
Gauss-Newton step of the joint problem)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import DAMPING_BOUNDS, TIME_CONSTANT_BOUNDS_S, SecondOrder
from stimrig.identify.dynamics.second_order import Core, step_matrix
from stimrig.identify.dynamics.states import held_states, read_means
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.descent import Damping, Search, Trial, descend
from stimrig.identify.estimation.rests import rest_levels
from stimrig.identify.recruitment import Basis
from stimrig.identify.recruitment.smoothing import choose_weight, straight_lines

CURVE_POINTS = 201
WIDE = 3.0
"""Coefficients of a curve are plausible within so many ranges of the torque."""
USUAL_NOISE = 0.02
"""Noise of an interval's mean, as a share of the torque's range, before anything is fitted."""
RATE_S = 0.2
"""An initial rate is plausible up to the torque's range in this time."""


@dataclass
class Projection:
    """One record and one basis: all that does not change while the dynamics are searched."""

    grid: Grid  # the record on the grid of pulses
    basis: Basis  # basis of the recruitment curve
    roughness: np.ndarray  # penalty on the coefficients, shape (P, P)
    rows: np.ndarray  # rows that are fitted, bool, shape (K,)
    delay_s: float | None = None  # a fixed delay; None to estimate it
    rests: tuple[np.ndarray, np.ndarray] = ()  # type: ignore
    """Zero of each part as its rests show it, and its sd, N·m, where they are known already (`rest_levels`)."""
    stretches: list[slice] = field(init=False)

    def __post_init__(self) -> None:
        self.stretches = self.grid.stretches(self.rows)
        if not self.stretches:
            raise NotIdentifiable("no row may be fitted", fix="Give rows outside `validate`.")
        self.rests = self.rests or rest_levels(self.grid, self.rows)

    @cached_property
    def rows_nm(self) -> np.ndarray:
        """Held drive of each interval, one row per coefficient: basis functions, then zeros for the initial states."""
        widths, place = self.grid.widths_us
        rows = np.zeros((self.basis.size + 2 * self.grid.starts.size, self.grid.size))
        rows[: self.basis.size] = self.grid.interval_means(self.basis.design(widths)[place].T, axis=1)
        return rows

    @cached_property
    def beginnings(self) -> np.ndarray:
        """Initial states of each row: zero for the basis functions, then unit torques and unit rates."""
        states = np.zeros((len(self.rows_nm), self.grid.starts.size, 2))
        for number in range(self.grid.starts.size):
            states[self.basis.size + 2 * number :, number][:2] = np.eye(2)
        return states

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

    @cached_property
    def above_rest(self) -> np.ndarray:
        """The target relative to the zero that the rests show, N·m: small numbers, whatever the sensor's offset."""
        return self.target - self.rests[0][self.grid.part]

    @cached_property
    def range_nm(self) -> float:
        """Range of the torque, N·m."""
        return max(float(np.ptp(self.target[self.rows])), 1e-9)

    @property
    def extras(self) -> int:
        """Number of linear columns besides recruitment: baselines, and torque and rate of each initial state."""
        return self.grid.begins.size + 2 * self.grid.starts.size

    def ridge(self, variance: float | None) -> np.ndarray:
        """Penalty on all coefficients, bending apart, at a noise variance: the prior of a `Setup`'s problem.

        It is small, and keeps at zero what no row shows; baselines are held as far as the rests pin them. None: the
        usual variance.
        """
        variance = (USUAL_NOISE * self.range_nm) ** 2 if variance is None else variance
        curve = np.full(self.basis.size, float(np.any(self.roughness)) * (self.range_nm * WIDE) ** -2)
        states = np.tile([1.0, RATE_S**2], self.grid.starts.size) * self.range_nm**-2
        return variance * np.r_[curve, self.rests[1] ** -2, states]

    def columns(self, linear: SecondOrder) -> np.ndarray:
        """Interval means of the response to each linear coefficient, shape (K, P + extras)."""
        even = np.tile(step_matrix(*linear.core, self.grid.step_s), (len(self.rows_nm), 1))
        weights = self.grid.mean_weights(linear.delay_s, self.grid.curve(linear.core))
        rows = read_means(*held_states(self.rows_nm, even, self.grid.starts, self.beginnings), *weights)
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


class Solution:
    """The joint linear problem solved for some dynamics.

    `ar1`: correlation of the noise, with which rows are whitened. `weight`: of the roughness penalty; by REML if it is
    not given. `variance`: about the variance of the innovations, N²m²: what the rests say of the zero is weighed
    against it.
    """

    def __init__(
        self,
        projection: Projection,
        linear: SecondOrder,
        *,
        ar1: float = 0.0,
        weight: float | None = None,
        variance: float | None = None,
    ) -> None:
        self.projection, self.linear, self.ar1, self.asked_variance = projection, linear, ar1, variance
        self.columns = projection.columns(linear)
        """Derivatives of the interval means by the coefficients, shape (K, P + extras)."""
        self.target = whiten(projection.above_rest, projection.stretches, ar1)
        self.rows = self.target.size
        self.white = whiten(self.columns, projection.stretches, ar1)
        self.zz, self.zy = self.white.T @ self.white, self.white.T @ self.target
        self.energy = float(self.target @ self.target)
        self.ridge = np.diag(projection.ridge(variance))
        self.weight = self._chosen() if weight is None else weight
        self.penalty = self._penalty(self.weight)
        self.above_rest = _solve(self.zz + self.penalty, self.zy)
        """The coefficients, with baselines relative to the zero that the rests show."""
        self.cost = self.energy - float(self.zy @ self.above_rest)

    def _chosen(self) -> float:
        roughness, free, null = self.projection.roughness, self.projection.extras, self.projection.null
        if not np.any(roughness):
            return 0.0
        size, bound = self.projection.basis.size, self.zz + self.ridge
        right = np.concatenate([bound[size:, :size], self.zy[size:, None]], axis=1)
        inner = _solve(bound[size:, size:], right)
        gram = bound[:size, :size] - bound[:size, size:] @ inner[:, :-1]
        moment = self.zy[:size] - bound[:size, size:] @ inner[:, -1]
        energy = self.energy - float(self.zy[size:] @ inner[:, -1])
        return choose_weight((gram + gram.T) / 2, moment, energy, self.rows, roughness, free, null).weight

    def cost_at(self, weight: float) -> float:
        """The penalised cost at this point with another weight."""
        return self.energy - float(self.zy @ _solve(self.zz + self._penalty(weight), self.zy))

    def _penalty(self, weight: float) -> np.ndarray:
        size, whole = self.projection.basis.size, self.ridge.copy()
        whole[:size, :size] += weight * self.projection.roughness
        return whole

    @cached_property
    def coefficients(self) -> np.ndarray:
        """Recruitment, the record's own baselines, initial states, shape (P + extras,)."""
        whole, size, level_nm = self.above_rest.copy(), self.projection.basis.size, self.projection.rests[0]
        whole[size : size + level_nm.size] += level_nm
        return whole

    @cached_property
    def residual_nm(self) -> np.ndarray:
        """Measured minus model on the grid, N·m, shape (K,); meaningful in rows with samples only."""
        return self.projection.target - self.columns @ self.coefficients

    @cached_property
    def curve(self) -> tuple[np.ndarray, np.ndarray]:
        """The recruitment curve: pulse widths, µs, and torques, N·m."""
        return curve_points(self.projection.basis, self.coefficients[: self.projection.basis.size])

    @cached_property
    def slopes(self) -> np.ndarray:
        """Derivatives of the interval means by the searched parameters, shape (K, 2 or 3)."""
        return self.projection.slopes(self.linear, self.above_rest)

    @cached_property
    def _bent(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        bent = whiten(self.slopes, self.projection.stretches, self.ar1)
        return self.white.T @ bent, bent.T @ bent, bent.T @ self.target

    @cached_property
    def _inner(self) -> np.ndarray:
        return _solve(self.zz + self.penalty, self._bent[0])

    @cached_property
    def information(self) -> np.ndarray:
        """Information matrix of the searched parameters, with the coefficients projected out."""
        cross, square, _ = self._bent
        return square - cross.T @ self._inner

    @cached_property
    def gradient(self) -> np.ndarray:
        """Along which the cost falls: half of its negative derivative by the searched parameters."""
        return self._bent[2] - self._inner.T @ self.zy

    @cached_property
    def freedom(self) -> float:
        """Effective number of parameters."""
        return float(np.trace(_solve(self.zz + self.penalty, self.zz))) + self.projection.searched

    @cached_property
    def squares(self) -> float:
        """Sum of squared innovations, at least that of rounding errors."""
        c = self.above_rest
        total = self.energy - 2 * float(self.zy @ c) + float(c @ self.zz @ c)
        return max(total, 1e-14 * self.energy, 1e-24 * self.rows)

    @property
    def variance(self) -> float:
        """Innovation variance on the grid, N²m²."""
        return self.squares / max(self.rows - self.freedom, 1.0)

    def whitened_variance(self, ar1: float) -> float:
        """Variance of the innovations, N²m², if neighbours are correlated so."""
        return float(np.mean(whiten(self.residual_nm, self.projection.stretches, ar1) ** 2))

    def step(self, damping: float, curved: np.ndarray) -> np.ndarray:
        """Step in (log T, log ζ, delay) by second derivatives; parameters at a bound do not leave it."""
        gradient = self.gradient
        free = ~_at_bound(self.projection, self.linear, gradient)
        step = np.zeros(gradient.size)
        if free.any():
            square = curved[np.ix_(free, free)]
            step[free] = _solve(square + damping * np.diag(np.diag(square)), gradient[free])
        return step


def curve_points(basis: Basis, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A curve on evenly spaced pulse widths."""
    u = np.linspace(0.0, basis.largest_us, CURVE_POINTS)
    return u, basis.design(u) @ coefficients


DAMPING = Damping(first=0.0, less=10.0, more=10.0, raised=1e-2)
NEGLIGIBLE = 1e-5
"""Damping below which there is none."""
REWEIGHTED = 2
"""After this many steps the weight of the penalty is kept, since a cost that changes has no minimum."""
CLOSE = 1e-2
"""A search ends when a step is smaller, in standard errors."""
LEAST_BEND = 0.05
"""Second derivatives are believed where, relative to the information, the cost bends at least so much everywhere."""


def search(
    projection: Projection, start: SecondOrder, *, ar1: float = 0.0, max_steps: int = 25, variance: float | None = None
) -> Solution:
    """Newton's method on the dynamics with the coefficients projected out, damped where a step fails.

    It makes at most so many steps; `ar1` and `variance` are those of `Solution`.
    """
    return descend_from(Solution(projection, bounded(projection, start), ar1=ar1, variance=variance), max_steps, CLOSE)


def descend_from(start: Solution, max_steps: int, tolerance: float) -> Solution:
    """The same from a solution. It ends when a step is smaller than `tolerance` standard errors."""
    projection, steps, bend = start.projection, 0, _Bend(start)

    def trials(at: Solution, _step: int, _damping: float) -> Trial[Solution]:
        curved = bend.at(at)

        def trial(damping: float) -> Solution | None:
            nonlocal steps
            steps += 1
            if steps > max_steps:
                return None
            step = at.step(damping if damping > NEGLIGIBLE else 0.0, curved)
            there = bounded(projection, _moved(at.linear, step))
            moved = _difference(at.linear, there)[: projection.searched]
            # Size of the step in standard errors, from the information matrix.
            size = float(np.sqrt(max(moved @ at.information @ moved, 0.0) * at.rows / at.squares))
            if size < tolerance or np.max(np.abs(moved)) < 1e-9:
                return None
            weight = None if steps <= REWEIGHTED else at.weight
            return Solution(projection, there, ar1=at.ar1, weight=weight, variance=at.asked_variance)

        return trial

    def gain(at: Solution, trial: Solution) -> float | None:
        against = at.cost if steps > REWEIGHTED else at.cost_at(trial.weight)
        return against - trial.cost if trial.cost <= against * (1 + 1e-9) else None

    return descend(Search(DAMPING, trials, gain), start, max_steps)[0]


class _Bend:
    """Correction of the information to the cost's second derivatives, learnt from changes of the gradient (SR1).

    Where the residual is large, steps by the information alone overshoot, time after time, and the search would end
    wherever its patience does (Dennis, Gay & Welsch 1981).
    """

    def __init__(self, start: Solution) -> None:
        self.before, self.matrix = start, np.zeros_like(start.information)

    def at(self, there: Solution) -> np.ndarray:
        """Second derivatives at an accepted solution, half of the cost's, shape (2, 2) or (3, 3)."""
        before, self.before = self.before, there
        if there is before or there.weight != before.weight:
            self.matrix = np.zeros_like(self.matrix)
            return there.information
        moved = _difference(before.linear, there.linear)[: len(self.matrix)]
        missing = before.gradient - there.gradient - (there.information + self.matrix) @ moved
        along = float(missing @ moved)
        if abs(along) > 1e-6 * float(np.linalg.norm(missing) * np.linalg.norm(moved)):
            self.matrix = self.matrix + np.outer(missing, missing) / along
        curved = there.information + self.matrix
        size = np.sqrt(np.diag(there.information))
        smallest = np.linalg.eigvalsh(curved / size / size[:, None])[0]
        return curved if smallest > LEAST_BEND else there.information


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric system, scaled to a unit diagonal, with a very small ridge for empty columns."""
    scale = 1.0 / np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    scaled = matrix * scale[:, None] * scale
    scaled.flat[:: scale.size + 1] = 1.0 + 1e-12
    lift = scale[:, None] if right.ndim == 2 else scale
    return lift * np.linalg.solve(scaled, lift * right)


def _moved(linear: SecondOrder, step: np.ndarray) -> SecondOrder:
    t, z = np.exp(np.clip(step[:2], -0.7, 0.7))
    delay = float(np.clip(step[2], -0.03, 0.03)) if step.size > 2 else 0.0
    return SecondOrder(linear.time_constant_s * float(t), linear.damping * float(z), linear.delay_s + delay)


def _difference(before: SecondOrder, after: SecondOrder) -> np.ndarray:
    longer = np.log(after.time_constant_s / before.time_constant_s)
    return np.array([longer, np.log(after.damping / before.damping), after.delay_s - before.delay_s])


def _at_bound(projection: Projection, linear: SecondOrder, gradient: np.ndarray) -> np.ndarray:
    """Flag the searched parameters that are at a bound and would leave it."""
    values = np.array([linear.time_constant_s, linear.damping, linear.delay_s])[: gradient.size]
    bounds = np.array([TIME_CONSTANT_BOUNDS_S, DAMPING_BOUNDS, projection.grid.delay_bounds_s])[: gradient.size]
    lower, upper = bounds[:, 0], bounds[:, 1]
    return ((values <= lower) & (gradient < 0)) | ((values >= upper) & (gradient > 0))


def bounded(projection: Projection, linear: SecondOrder) -> SecondOrder:
    """The dynamics within the bounds of the search, with the delay that is given."""
    limited = linear.bounded(projection.grid.delay_bounds_s)
    return limited if projection.delay_s is None else replace(limited, delay_s=projection.delay_s)


LARGEST_AR1 = 0.995


def whiten(rows: np.ndarray, stretches: list[slice], ar1: float) -> np.ndarray:
    """Whiten rows of AR(1) noise (residuals or design columns on the grid) exactly, stretch by stretch.

    `stretches`: runs of fitted rows; correlation does not cross from one to the next. Returns the fitted rows in order.
    The first of each stretch is scaled by sqrt(1 - ar1²), so that the likelihood is that of the stationary process.
    """
    if ar1 == 0.0:
        parts = [rows[stretch] for stretch in stretches]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)
    parts = []
    for stretch in stretches:
        block = rows[stretch]
        out = block.copy()
        out[1:] -= ar1 * block[:-1]
        out[0] *= np.sqrt(1.0 - ar1 * ar1)
        parts.append(out)
    return np.concatenate(parts)


def log_likelihood(residual: np.ndarray, stretches: list[slice], ar1: float) -> float:
    """Exact Gaussian AR(1) log-likelihood with the innovation's variance profiled out.

    `residual`, N·m, has shape (K,); all is as in `whiten`.
    """
    white = whiten(residual, stretches, ar1)
    variance = max(float(white @ white) / white.size, 1e-24)
    jacobian = 0.5 * len(stretches) * np.log1p(-ar1 * ar1)
    return -0.5 * white.size * (np.log(2 * np.pi * variance) + 1.0) + jacobian


def best_ar1(residual: np.ndarray, stretches: list[slice]) -> float:
    """Correlation of neighbours that makes the residual most likely, in [-0.5, LARGEST_AR1]."""
    lead = sum(float(residual[s] @ residual[s]) for s in stretches)
    lag = sum(float(residual[s][1:] @ residual[s][:-1]) for s in stretches)
    inner = sum(float(residual[s][1:-1] @ residual[s][1:-1]) for s in stretches)
    rows = sum(s.stop - s.start for s in stretches)

    def score(ar1: np.ndarray) -> np.ndarray:
        squares = np.maximum(lead - 2 * ar1 * lag + ar1 * ar1 * inner, 1e-24 * rows)
        return -0.5 * rows * np.log(squares) + 0.5 * len(stretches) * np.log1p(-ar1 * ar1)

    low, high, optimum = -0.5, LARGEST_AR1, 0.0
    for _ in range(3):  # the score has one maximum: three scans, each finer, find it to 1e-5
        trial = np.linspace(low, high, 61)
        best = int(np.argmax(score(trial)))
        low, high, optimum = float(trial[max(best - 1, 0)]), float(trial[min(best + 1, 60)]), float(trial[best])
    return optimum


def ar1_or_white(residual: np.ndarray, stretches: list[slice]) -> tuple[float, float]:
    """Choose AR(1) or white noise: the correlation (0 for white), and ΔBIC (positive in favour of AR(1)).

    `residual`, N·m, has shape (K,); all is as in `whiten`.
    """
    ar1 = best_ar1(residual, stretches)
    rows = sum(s.stop - s.start for s in stretches)
    gain = log_likelihood(residual, stretches, ar1) - log_likelihood(residual, stretches, 0.0)
    delta_bic = 2 * gain - float(np.log(max(rows, 2)))
    return (ar1 if delta_bic > 0 else 0.0), delta_bic

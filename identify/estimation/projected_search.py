"""Variable projection: a joint estimate of recruitment and dynamics that searches only three parameters.

For given (T, ζ, delay) the model is linear in the recruitment coefficients, the baseline and the initial state. These
are solved for exactly; only the three parameters are searched (Golub & Pereyra 1973, with the Jacobian of Kaufman: the
Gauss-Newton step of the joint problem).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numba import njit

from stimrig.identify.dynamics.linear import DAMPING_BOUNDS, TIME_CONSTANT_BOUNDS_S, SecondOrder
from stimrig.identify.estimation.projection import Projection, Solution
from stimrig.identify.noise.ar1 import whiten
from stimrig.identify.recruitment.smoothing import choose_weight

REWEIGHTED = 2
"""After this many steps the weight of the penalty is kept, since a cost that changes has no minimum."""


def search(
    projection: Projection,
    start: SecondOrder,
    *,
    ar1: float = 0.0,
    most: int = 25,
) -> Solution:
    """Gauss-Newton on the dynamics with the coefficients projected out, damped where a step fails.

    Parameters
    ----------
    projection : Projection
        Record and basis.
    start : SecondOrder
        Start.
    ar1 : float
        Correlation of the noise.
    most : int
        Largest number of steps.
    """
    target = whiten(projection.target, projection.stretches, ar1)
    return descend(State(projection, bounded(projection, start), target, ar1, None), most, tolerance=0.01)


def descend(state: State, most: int, tolerance: float) -> Solution:
    """The same from a state. It ends when a step is smaller than `tolerance` standard errors."""
    projection, linear, target, ar1 = state.projection, state.linear, state.target, state.ar1
    damping, taken = 0.0, 0
    while taken < most:
        taken += 1
        step = state.step(damping)
        trial = bounded(projection, _moved(linear, step))
        moved = _difference(linear, trial)[: projection.searched]
        # Size of the step in standard errors, from the information matrix.
        size = float(np.sqrt(max(moved @ state.information @ moved, 0.0) * target.size / state.squares))
        if size < tolerance or np.max(np.abs(moved)) < 1e-9:
            break
        keep = None if taken <= REWEIGHTED else state.weight
        attempt = State(projection, trial, target, ar1, keep)
        against = state.cost if keep is not None else state.cost_at(attempt.weight)
        if attempt.cost <= against * (1 + 1e-9):
            linear, state, damping = trial, attempt, damping / 10 if damping > 1e-4 else 0.0
        else:
            damping = max(10 * damping, 1e-2)
            if damping > 1e8:
                break
    return state.solution()


def project(projection: Projection, linear: SecondOrder, *, ar1: float = 0.0, weight: float | None = None) -> Solution:
    """Coefficients for given dynamics: only the linear part of the problem."""
    return State(projection, linear, whiten(projection.target, projection.stretches, ar1), ar1, weight).solution()


class State:
    """The joint linear problem at one point of the search; without a weight of the roughness, the one by REML."""

    def __init__(
        self, projection: Projection, linear: SecondOrder, target: np.ndarray, ar1: float, weight: float | None
    ) -> None:
        self.projection, self.linear, self.target, self.ar1 = projection, linear, target, ar1
        self.columns = projection.columns(linear)
        white = whiten(self.columns, projection.stretches, ar1)
        self.zz, self.zy = white.T @ white, white.T @ target
        self.energy = float(target @ target)
        size = projection.basis.size
        self.weight = self._chosen(size) if weight is None else weight
        self.penalty = np.zeros_like(self.zz)
        self.penalty[:size, :size] = self.weight * projection.roughness
        self.penalty[size:, size:] = np.diag(projection.ridge)
        self.coefficients = _solve(self.zz + self.penalty, self.zy)
        self.cost = self.energy - float(self.zy @ self.coefficients)
        self.white = white

    @cached_property
    def slopes(self) -> np.ndarray:
        """Derivatives by the searched parameters, shape (K, 2 or 3)."""
        return self.projection.slopes(self.linear, self.coefficients)

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
    def freedom(self) -> float:
        """Effective number of parameters."""
        return float(np.trace(_solve(self.zz + self.penalty, self.zz))) + self.slopes.shape[1]

    @cached_property
    def squares(self) -> float:
        """Sum of squared innovations, at least that of rounding errors."""
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
        inner = _solve(outer + np.diag(self.projection.ridge), right)
        gram = self.zz[:size, :size] - self.zz[:size, size:] @ inner[:, :-1]
        moment = self.zy[:size] - self.zz[:size, size:] @ inner[:, -1]
        energy = self.energy - float(self.zy[size:] @ inner[:, -1])
        if not np.any(self.projection.roughness):
            return 0.0
        roughness, free, null = self.projection.roughness, self.projection.extras, self.projection.null
        return choose_weight((gram + gram.T) / 2, moment, energy, self.target.size, roughness, free, null).weight

    def cost_at(self, weight: float) -> float:
        """The penalised cost at this point with another weight."""
        size = self.projection.basis.size
        other = self.penalty.copy()
        other[:size, :size] = weight * self.projection.roughness
        return self.energy - float(self.zy @ _solve(self.zz + other, self.zy))

    def step(self, damping: float) -> np.ndarray:
        """Step in (log T, log ζ, delay); parameters at a bound do not leave it."""
        moment = self._bent[2]
        gradient = moment - self._inner.T @ self.zy
        free = ~_held(self.projection, self.linear, gradient)
        step = np.zeros(gradient.size)
        if free.any():
            information = self.information[np.ix_(free, free)]
            step[free] = _solve(information + damping * np.diag(np.diag(information)), gradient[free])
        return step

    def solution(self) -> Solution:
        """The result at this point."""
        return Solution(
            projection=self.projection,
            linear=self.linear,
            coefficients=self.coefficients,
            weight=self.weight,
            ar1=self.ar1,
            columns=self.columns,
            slopes=self.slopes,
            freedom=self.freedom,
            variance=self.variance,
        )


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric system, scaled to a unit diagonal, with a very small ridge for empty columns."""
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
    longer = np.log(after.time_constant_s / before.time_constant_s)
    return np.array([longer, np.log(after.damping / before.damping), after.delay_s - before.delay_s])


def _held(projection: Projection, linear: SecondOrder, gradient: np.ndarray) -> np.ndarray:
    """Which searched parameters are at a bound and would leave it."""
    values = np.array([linear.time_constant_s, linear.damping, linear.delay_s])[: gradient.size]
    bounds = np.array([TIME_CONSTANT_BOUNDS_S, DAMPING_BOUNDS, projection.grid.delay_bounds_s])[: gradient.size]
    lower, upper = bounds[:, 0], bounds[:, 1]
    return ((values <= lower) & (gradient < 0)) | ((values >= upper) & (gradient > 0))


def bounded(projection: Projection, linear: SecondOrder) -> SecondOrder:
    """The dynamics within the bounds of the search, with the delay that is given."""
    found = linear.bounded(projection.grid.delay_bounds_s)
    return found if projection.delay_s is None else replace(found, delay_s=projection.delay_s)

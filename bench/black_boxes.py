"""Black boxes in the manner of the well-known toolbox and of recent papers, plain: numpy and scipy alone.

Each fits the rows that may be fitted and predicts all rows in free run, from the inputs and the fitted rows at the
begin. Their settings are fixed for all tasks; where they choose, they choose on fitted rows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import least_squares, minimize
from scipy.signal import lfilter, lfilter_zi

from bench.tasks import Task

Predict = Callable[[], np.ndarray]
BUDGET_S = 20.0
"""A box stops looking for better starts after this."""


@dataclass(frozen=True)
class Scaled:
    """A task's input from 0 to 1, its output in standard deviations of the fitted rows about their mean."""

    task: Task

    @property
    def u(self) -> np.ndarray:
        width = self.task.record.pulse_width_us
        return (width - width.min()) / np.ptp(width)

    @property
    def y(self) -> np.ndarray:
        mean, sd = self._level()
        return (self.task.record.torque_nm - mean) / sd

    def back(self, y: np.ndarray) -> np.ndarray:
        mean, sd = self._level()
        return mean + sd * y

    def _level(self) -> tuple[float, float]:
        fitted = self.task.record.torque_nm[self.task.fitted]
        return float(fitted.mean()), float(fitted.std())


def best_start(fits: Iterator[tuple[float, np.ndarray]]) -> np.ndarray:
    """Return the parameters of the start with the smallest cost, within the budget."""
    end = time.perf_counter() + BUDGET_S
    best = (np.inf, np.empty(0))
    for cost, parameters in fits:
        best = (cost, parameters) if cost < best[0] else best
        if time.perf_counter() > end:
            break
    return best[1]


# ---- Hammerstein-Wiener: piecewise linear, second or third order, piecewise linear; output error ----

IN_KNOTS, OUT_KNOTS = np.linspace(0.0, 1.0, 9), np.linspace(-3.0, 3.0, 7)


def _hammerstein_wiener(x: np.ndarray, order: int, u: np.ndarray) -> np.ndarray:
    """x: values at the knots of the input and of the output, rates, numerator, and the level before the begin."""
    shape_in, shape_out = x[: IN_KNOTS.size], x[IN_KNOTS.size : IN_KNOTS.size + OUT_KNOTS.size]
    more = x[IN_KNOTS.size + OUT_KNOTS.size :]
    a = np.poly(_poles(more[:order]))
    numerator, begin = more[order : 2 * order], more[2 * order]
    b = np.r_[0.0, 1.0 - numerator[1:].sum(), numerator[1:]] * a.sum()
    drive = np.interp(u, IN_KNOTS, shape_in)
    linear = lfilter(b, a, drive, zi=lfilter_zi(b, a) * (drive[0] + begin))[0]
    inner = np.interp(linear, OUT_KNOTS, shape_out)
    slopes = (shape_out[1] - shape_out[0], shape_out[-1] - shape_out[-2])
    below, above = np.minimum(linear - OUT_KNOTS[0], 0.0), np.maximum(linear - OUT_KNOTS[-1], 0.0)
    return inner + slopes[0] * below + slopes[1] * above


def _poles(x: np.ndarray) -> np.ndarray:
    """Stable ones: a pair from natural frequency and damping, and a real one."""
    frequency, damping = np.exp(np.clip(x[:2], -8.0, 3.0))
    root = np.sqrt(complex(damping**2 - 1.0))
    pair = np.exp(np.clip(frequency * np.array([-damping + root, -damping - root]), -30.0, 0.0))
    return np.r_[pair, np.exp(-np.exp(np.clip(x[2:], -8.0, 3.0)))]


def hammerstein_wiener(task: Task) -> Predict:
    """`nlhw`: orders two and three, from three speeds each; the one with the smallest error and cost of parameters."""
    scaled = Scaled(task)
    u, y, fitted = scaled.u, scaled.y, task.fitted
    top = float(np.percentile(y[fitted], 98))

    def simulate(x: np.ndarray, order: int) -> np.ndarray:
        return _hammerstein_wiener(x, order, u)

    def fits() -> Iterator[tuple[float, np.ndarray]]:
        for lag in (4.0, 15.0, 1.5):
            for order in (2, 3):
                inner = y.min() + (top - y.min()) * IN_KNOTS
                poles = np.r_[-np.log(lag), 0.0, np.log(0.5)][:order]
                start = np.r_[inner, OUT_KNOTS, poles, np.zeros(order), 0.0]
                tie = np.r_[np.full(start.size - 1, 1e-2), 0.1]

                def residual(x: np.ndarray, order: int = order, start: np.ndarray = start, tie=tie) -> np.ndarray:
                    return np.r_[(simulate(x, order) - y)[fitted], tie * (x - start)]

                solution = least_squares(residual, start, method="trf", x_scale=0.3, max_nfev=60)
                rows = int(fitted.sum())
                yield rows * np.log(2 * solution.cost / rows) + np.log(rows) * start.size, np.r_[order, solution.x]

    best = best_start(fits())
    return lambda: scaled.back(simulate(best[1:], int(best[0])))


# ---- Gaussian process on lagged inputs ----

EDGES = np.unique(np.round(np.geomspace(1, 81, 14)).astype(int)) - 1
"""Means of the input over these windows, in samples: 2 s of memory at 40 a second."""
INDUCING, SEARCHED = 400, 300


def gaussian_process(task: Task) -> Predict:
    """Input means over windows that grow with their age; a linear and a squared exponential kernel, Nyström.

    Hyperparameters are of the greatest likelihood of 300 rows, spread evenly; then 400 inducing rows for all.
    """
    scaled = Scaled(task)
    y, fitted = scaled.y, np.flatnonzero(task.fitted)
    lagged_inputs = scaled.u[np.maximum(np.arange(y.size)[:, None] - np.arange(EDGES[-1] + 1), 0)]
    x = np.stack([lagged_inputs[:, a : max(b, a + 1)].mean(axis=1) for a, b in pairwise(EDGES)], axis=1)
    some = fitted[np.linspace(0, fitted.size - 1, min(SEARCHED, fitted.size)).astype(int)]

    def kernel(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        scale = np.exp(p[3:])
        gap = np.sum((a * scale) ** 2, 1)[:, None] + np.sum((b * scale) ** 2, 1) - 2 * (a * scale) @ (b * scale).T
        return np.exp(2 * p[0]) * np.exp(-0.5 * np.maximum(gap, 0)) + np.exp(2 * p[1]) * (
            1 + (a * scale) @ (b * scale).T
        )

    def cost(p: np.ndarray) -> float:
        whole = kernel(p, x[some], x[some]) + (np.exp(2 * p[2]) + 1e-6) * np.eye(some.size)
        factor = cho_factor(whole, lower=True)
        fit = y[some] @ cho_solve(factor, y[some])
        return float(0.5 * fit + np.log(np.diag(factor[0])).sum() + 0.05 * np.sum((p - start) ** 2))

    start = np.r_[0.0, 0.0, -2.0, np.zeros(x.shape[1])]
    bounds = [(-6.0, 4.0)] * start.size
    hyperparameters = minimize(cost, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": 25}).x
    inducing = fitted[np.linspace(0, fitted.size - 1, min(INDUCING, fitted.size)).astype(int)]
    root = np.linalg.cholesky(kernel(hyperparameters, x[inducing], x[inducing]) + 1e-6 * np.eye(inducing.size))
    rows = solve_triangular(root, kernel(hyperparameters, x[inducing], x), lower=True)
    noise = np.exp(2 * hyperparameters[2]) + 1e-6
    inner = rows[:, fitted] @ rows[:, fitted].T + noise * np.eye(inducing.size)
    weights = np.linalg.solve(inner, rows[:, fitted] @ y[fitted])
    return lambda: scaled.back(weights @ rows)

"""Black boxes in the manner of the well-known toolbox and of recent papers, plain: numpy, scipy and numba alone.

Each fits the rows that may be fitted and predicts all rows in free run, from the inputs and the fitted rows at the
begin of each part. Their settings are fixed for all tasks; where they choose, they choose on fitted rows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numba import njit
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


def lagged(column: np.ndarray, parts: list[slice], lags: range) -> np.ndarray:
    """Earlier values, shape (N, lags); before a part's begin its first value."""
    at = np.concatenate([np.maximum(np.arange(p.stop - p.start)[:, None] - lags, 0) + p.start for p in parts])
    return column[at]


def several(fits: Iterator[tuple[float, np.ndarray]]) -> np.ndarray:
    """The parameters of the start with the smallest cost, within the budget."""
    end = time.perf_counter() + BUDGET_S
    best = (np.inf, np.empty(0))
    for cost, found in fits:
        best = (cost, found) if cost < best[0] else best
        if time.perf_counter() > end:
            break
    return best[1]


# ---- Hammerstein-Wiener: piecewise linear, second or third order, piecewise linear; output error ----

IN_KNOTS, OUT_KNOTS = np.linspace(0.0, 1.0, 9), np.linspace(-3.0, 3.0, 7)


def _hammerstein_wiener(x: np.ndarray, order: int, u: np.ndarray, parts: list[slice]) -> np.ndarray:
    """x: values at the knots of the input and of the output, rates, numerator, and levels before the begins."""
    shape_in, shape_out = x[: IN_KNOTS.size], x[IN_KNOTS.size : IN_KNOTS.size + OUT_KNOTS.size]
    more = x[IN_KNOTS.size + OUT_KNOTS.size :]
    a = np.poly(_poles(more[:order]))
    numerator, begins = more[order : 2 * order], more[2 * order :]
    b = np.r_[0.0, 1.0 - numerator[1:].sum(), numerator[1:]] * a.sum()
    drive = np.interp(u, IN_KNOTS, shape_in)
    rest = lfilter_zi(b, a)
    linear = np.concatenate(
        [lfilter(b, a, drive[p], zi=rest * (drive[p.start] + off))[0] for p, off in zip(parts, begins, strict=True)]
    )
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
    u, y, parts, fitted = scaled.u, scaled.y, task.parts, task.fitted
    top = float(np.percentile(y[fitted], 98))

    def simulate(x: np.ndarray, order: int) -> np.ndarray:
        return _hammerstein_wiener(x, order, u, parts)

    def fits() -> Iterator[tuple[float, np.ndarray]]:
        for lag in (4.0, 15.0, 1.5):
            for order in (2, 3):
                inner = y.min() + (top - y.min()) * IN_KNOTS
                poles = np.r_[-np.log(lag), 0.0, np.log(0.5)][:order]
                start = np.r_[inner, OUT_KNOTS, poles, np.zeros(order), np.zeros(len(parts))]
                tie = np.r_[np.full(start.size - len(parts), 1e-2), np.full(len(parts), 0.1)]

                def residual(x: np.ndarray, order: int = order, start: np.ndarray = start, tie=tie) -> np.ndarray:
                    return np.r_[(simulate(x, order) - y)[fitted], tie * (x - start)]

                found = least_squares(residual, start, method="trf", x_scale=0.3, max_nfev=60)
                rows = int(fitted.sum())
                yield rows * np.log(2 * found.cost / rows) + np.log(rows) * start.size, np.r_[order, found.x]

    best = several(fits())
    return lambda: scaled.back(simulate(best[1:], int(best[0])))


# ---- nlarx: a linear part and a sigmoid network of lagged outputs and inputs; one-step error, free run ----

LAGS, UNITS = 3, 8


@njit
def _free_run(w, hidden, outer, inputs, first, begins):
    y = np.empty(inputs.shape[0])
    z = np.empty(w.size)
    units, width = hidden.shape
    for k in range(y.size):
        if k - begins[k] < LAGS:
            y[k] = first[k]
            continue
        z[0] = 1.0
        for j in range(LAGS):
            z[1 + j] = y[k - 1 - j]
            z[1 + LAGS + j] = inputs[k, j]
        value = 0.0
        for i in range(width):
            value += w[i] * z[i]
        for h in range(units):
            inner = 0.0
            for i in range(width):
                inner += hidden[h, i] * z[i]
            value += outer[h] * np.tanh(inner)
        y[k] = min(max(value, -6.0), 6.0)
    return y


def nlarx(task: Task) -> Predict:
    """`nlarx`: trained on the error of one step, as the toolbox does by default; the best free run of six starts."""
    scaled = Scaled(task)
    u, y, parts = scaled.u, scaled.y, task.parts
    inputs = lagged(u, parts, range(1, 1 + LAGS))
    z = np.c_[np.ones(y.size), lagged(y, parts, range(1, 1 + LAGS)), inputs]
    begins = np.concatenate([np.full(p.stop - p.start, p.start) for p in parts])
    usable = np.flatnonzero(task.fitted & (np.arange(y.size) - begins >= LAGS))
    usable = usable[np.all(task.fitted[usable[:, None] - np.arange(1, 1 + LAGS)], axis=1)]
    z, target, width = z[usable], y[usable], z.shape[1]

    def split(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return x[:width], x[width : width * (1 + UNITS)].reshape(UNITS, width), x[-UNITS:]

    def run(x: np.ndarray) -> np.ndarray:
        return _free_run(*split(x), inputs, y, begins)

    def residual(x: np.ndarray) -> np.ndarray:
        w, hidden, outer = split(x)
        return np.r_[z @ w + np.tanh(z @ hidden.T) @ outer - target, 1e-2 * x[width:]]

    def slope(x: np.ndarray) -> np.ndarray:
        _, hidden, outer = split(x)
        active = np.tanh(z @ hidden.T)
        inner = ((1 - active**2) * outer)[:, :, None] * z[:, None, :]
        rows = np.c_[z, inner.reshape(len(z), -1), active]
        return np.r_[rows, np.c_[np.zeros((x.size - width, width)), 1e-2 * np.eye(x.size - width)]]

    def fits() -> Iterator[tuple[float, np.ndarray]]:
        linear = np.linalg.lstsq(z, target, rcond=None)[0]
        for seed in range(6):
            rng = np.random.default_rng(seed)
            start = np.r_[linear, 0.5 * rng.standard_normal(UNITS * width), 0.1 * rng.standard_normal(UNITS)]
            found = least_squares(residual, start, slope, max_nfev=100).x  # pyright: ignore[reportArgumentType]
            yield float(np.mean((run(found) - y)[task.fitted] ** 2)), found

    best = several(fits())
    return lambda: scaled.back(run(best))


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
    past = lagged(scaled.u, task.parts, range(EDGES[-1] + 1))
    x = np.stack([past[:, a : max(b, a + 1)].mean(axis=1) for a, b in pairwise(EDGES)], axis=1)
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
    found = minimize(cost, start, method="L-BFGS-B", bounds=[(-6.0, 4.0)] * start.size, options={"maxiter": 25}).x
    kept = fitted[np.linspace(0, fitted.size - 1, min(INDUCING, fitted.size)).astype(int)]
    root = np.linalg.cholesky(kernel(found, x[kept], x[kept]) + 1e-6 * np.eye(kept.size))
    rows = solve_triangular(root, kernel(found, x[kept], x), lower=True)
    noise = np.exp(2 * found[2]) + 1e-6
    inner = rows[:, fitted] @ rows[:, fitted].T + noise * np.eye(kept.size)
    weights = np.linalg.solve(inner, rows[:, fitted] @ y[fitted])
    return lambda: scaled.back(weights @ rows)


# ---- a small neural state space, on simulation error ----

STATES, NEURONS = 3, 6


@njit
def _states(x, u, begins, part, derivatives):
    """Output, and its derivatives by the parameters carried forward; x: A, B, hidden, outer, C, begins."""
    s, h, d = STATES, NEURONS, x.size
    width = s + 2
    at_b = s * s
    at_h = at_b + 2 * s
    at_o = at_h + h * width
    at_c = at_o + s * h
    at_0 = at_c + s + 1
    y, slope = np.empty(u.size), np.zeros((u.size if derivatives else 1, d))
    state, carried = np.zeros(s), np.zeros((s, d))
    active, z = np.empty(h), np.empty(width)
    local, gain = np.empty((s, s)), np.empty(s)
    for k in range(u.size):
        if begins[k]:
            carried[:] = 0.0
            for i in range(s):
                state[i] = x[at_0 + part[k] * s + i]
                carried[i, at_0 + part[k] * s + i] = 1.0
        value = x[at_c + s]
        for i in range(s):
            value += x[at_c + i] * state[i]
        y[k] = value
        if derivatives:
            for j in range(d):
                total = 0.0
                for i in range(s):
                    total += x[at_c + i] * carried[i, j]
                slope[k, j] = total
            for i in range(s):
                slope[k, at_c + i] += state[i]
            slope[k, at_c + s] += 1.0
        z[:s] = state
        z[s], z[s + 1] = u[k], 1.0
        for n in range(h):
            inner = 0.0
            for i in range(width):
                inner += x[at_h + n * width + i] * z[i]
            active[n] = np.tanh(inner)
        if derivatives:
            for i in range(s):
                for j in range(s):
                    total = x[i * s + j]
                    for n in range(h):
                        total += x[at_o + i * h + n] * (1 - active[n] ** 2) * x[at_h + n * width + j]
                    local[i, j] = total
            carried = local @ carried
            for i in range(s):
                for j in range(s):
                    carried[i, i * s + j] += state[j]
                carried[i, at_b + 2 * i] += u[k]
                carried[i, at_b + 2 * i + 1] += 1.0
                for n in range(h):
                    carried[i, at_o + i * h + n] += active[n]
                    bent = x[at_o + i * h + n] * (1 - active[n] ** 2)
                    for j in range(width):
                        carried[i, at_h + n * width + j] += bent * z[j]
        for i in range(s):
            total = x[at_b + 2 * i] * u[k] + x[at_b + 2 * i + 1]
            for j in range(s):
                total += x[i * s + j] * state[j]
            for n in range(h):
                total += x[at_o + i * h + n] * active[n]
            gain[i] = total
        for i in range(s):
            state[i] = min(max(gain[i], -50.0), 50.0)
    return y, slope


def neural_states(task: Task) -> Predict:
    """Three states: a linear part beside six neurons. Levenberg-Marquardt on the whole simulated fitted rows.

    SUBNET's kin: no encoder (each part's begin is estimated) and no short sections, since exact derivatives are at
    hand. The last fifth of the fitted rows, kept aside, chooses among speeds of the start and sizes of the ridge.
    """
    scaled = Scaled(task)
    u, y, parts, fitted = scaled.u, scaled.y, task.parts, np.flatnonzero(task.fitted)
    begins, part = np.zeros(y.size, bool), np.zeros(y.size, np.int64)
    for number, rows in enumerate(parts):
        begins[rows.start], part[rows] = True, number
    kept = fitted[: int(0.8 * fitted.size)]
    aside = fitted[kept.size :]
    plain = STATES * STATES + 2 * STATES + NEURONS * (STATES + 2) + STATES * NEURONS + STATES + 1
    alike = np.eye(plain + STATES * len(parts))  # later parts begin as the first one, but for a difference
    for number in range(1, len(parts)):
        rows = plain + STATES * number
        alike[rows : rows + STATES, plain : plain + STATES] = np.eye(STATES)

    def run(x: np.ndarray) -> np.ndarray:
        return _states(alike @ x, u, begins, part, False)[0]

    def fit(start: np.ndarray, rows: np.ndarray, ridge: float) -> np.ndarray:
        tie = np.full(start.size, ridge)
        tie[: STATES * STATES], tie[plain:] = 0.0, 0.1

        def residual(x: np.ndarray) -> np.ndarray:
            return np.r_[(run(x) - y)[rows], tie * x]

        def slope(x: np.ndarray) -> np.ndarray:
            return np.r_[_states(alike @ x, u, begins, part, True)[1][rows] @ alike, np.diag(tie)]

        found = least_squares(residual, start, slope, x_scale=0.2, max_nfev=60)  # pyright: ignore[reportArgumentType]
        return found.x

    def fits() -> Iterator[tuple[float, np.ndarray]]:
        for ridge, (seed, lag) in product((0.01, 0.1, 0.5), enumerate((4.0, 15.0))):
            rng = np.random.default_rng(seed)
            linear = np.diag(np.exp(-1.0 / (lag * np.array([1.0, 0.6, 0.3]))))
            linear[1, 0], linear[2, 1] = 1 - linear[1, 1], 1 - linear[2, 2]
            drive = np.array([[1 - linear[0, 0], 0.0], [0.0, 0.0], [0.0, 0.0]])
            net = 0.3 * rng.standard_normal(NEURONS * (STATES + 2)), 0.01 * rng.standard_normal(STATES * NEURONS)
            start = np.r_[linear.ravel(), drive.ravel(), *net, 0.0, 1.0, 0.0, y.min(), np.zeros(STATES * len(parts))]
            found = fit(start, kept, ridge)
            yield float(np.mean((run(found) - y)[aside] ** 2)), np.r_[ridge, found]

    ridge, *start = several(fits())
    best = fit(np.array(start), fitted, ridge)
    return lambda: scaled.back(run(best))

"""The linear part of equations (1) to (3), and both stages with it: coefficients b and a of a given or chosen order.

Least squares on the equation error (25) is biased by output noise, since the regressors contain it (at 0.02 N·m and
40 Hz it gives Tω = 2.1 s instead of 0.53 s). Here the cost is (12), the error of the model's output in a free run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import Discrete
from stimrig.identify.dynamics.second_order import recursion
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.descent import Damping, Search, Trial, descend
from stimrig.identify.estimation.finish import finish_discrete
from stimrig.identify.estimation.plain import pilot
from stimrig.identify.methods.common import near_rest, quiet_level, shifted, with_past
from stimrig.identify.model import Model
from stimrig.identify.recruitment import Curve
from stimrig.identify.recruitment.bases import SplineBasis
from stimrig.identify.recruitment.smoothing import PILOT_KNOTS, adapted_knots, choose_weight, spline_roughness

LARGEST_POLE = 0.9995
MAX_DELAYS = 4
DAMPING = Damping(first=1e-3, less=10.0, more=10.0, smallest=1e-12)


@dataclass(frozen=True)
class OutputError:
    """A fitted linear block: coefficients of equations (2) and (3), with the gain."""

    b: np.ndarray
    a: np.ndarray
    delay_samples: int
    bic: float  # smaller is better

    def block(self, step_s: float, centre: float) -> Discrete:
        """The block with unit gain at DC."""
        gain = float(np.sum(self.b) / np.sum(self.a))
        return Discrete(tuple(self.b / gain), tuple(self.a), self.delay_samples, step_s, centre)


def stable(a: np.ndarray) -> np.ndarray:
    """A with poles outside the unit circle mirrored into it; all poles have at most the modulus 0.9995."""
    roots = np.roots(a)
    size = np.abs(roots)
    roots = np.where(size > 1, roots / np.maximum(size, 1e-12) ** 2, roots)
    roots = roots * np.minimum(1.0, LARGEST_POLE / np.maximum(np.abs(roots), 1e-12))
    return np.real(np.poly(roots))


@dataclass(frozen=True)
class _Run:
    """A denominator, what it makes of the inputs, the rest solved for, the output, and its squared error."""

    a: np.ndarray
    columns: list[np.ndarray]
    theta: np.ndarray
    fitted: np.ndarray
    cost: float


def equation_error(
    torque: np.ndarray, drive: np.ndarray, rows: np.ndarray, order: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """(b, a) by equation (25), literally: least squares of (24) with rows of (23)."""
    poles, zeros, delay = order
    used = with_past(rows, max(poles, zeros + delay))
    columns = np.stack(_regressors(drive, torque, order), axis=1)
    theta = np.linalg.lstsq(columns[used], torque[used], rcond=None)[0]
    return theta[: zeros + 1], np.r_[1.0, theta[zeros + 1 :]]


def _regressors(drive: np.ndarray, torque: np.ndarray, order: tuple[int, int, int]) -> list[np.ndarray]:
    """Past drives and torques of equation (23), each of shape (K,)."""
    poles, zeros, delay = order
    drives = [shifted(drive, delay + j) for j in range(zeros + 1)]
    return drives + [-shifted(torque, j) for j in range(1, poles + 1)]


def output_error(
    torque: np.ndarray,
    drive: np.ndarray,
    rows: np.ndarray,
    order: tuple[int, int, int],
    start: np.ndarray | None = None,
    max_steps: int = 40,
) -> OutputError:
    """Minimise (12) over b, a and a baseline, for a given order (l, n, d): poles, zeros, delay.

    `torque`: relative to its zero, since rows that are not fitted count as zero in filtered signals.
    `start`: for A; by default from (25), improved by the iteration of Steiglitz and McBride.

    Raises NotIdentifiable: the input never changes.
    """
    poles, zeros, delay = order
    if not np.ptp(drive) > 0:
        raise NotIdentifiable("the input of the linear block never changes", fix="Record a PRBS.")
    target = np.where(rows, np.nan_to_num(torque), 0.0)

    def solve(a: np.ndarray) -> _Run:
        columns = [recursion(a, shifted(drive, delay + j).copy()) for j in range(zeros + 1)]
        design = np.stack([*columns, np.ones(drive.size)], axis=1)
        theta = np.linalg.lstsq(design[rows], target[rows], rcond=None)[0]
        fitted = design @ theta
        error = (target - fitted)[rows]
        return _Run(a, columns, theta, fitted, float(error @ error))

    def trials(at: _Run, _step: int, _damping: float) -> Trial[_Run]:
        inner = at.fitted - at.theta[-1]
        slopes = [-recursion(at.a, shifted(inner, j).copy()) for j in range(1, poles + 1)]
        jacobian = np.stack([*slopes, *at.columns, np.ones(drive.size)], axis=1)[rows]
        scale = np.linalg.norm(jacobian, axis=0) + 1e-300
        jacobian /= scale
        gram, right = jacobian.T @ jacobian, jacobian.T @ (target - at.fitted)[rows]

        def trial(damping: float) -> _Run:
            step = np.linalg.solve(gram + damping * np.eye(len(gram)), right) / scale
            return solve(stable(np.r_[1.0, at.a[1:] + step[:poles]]))

        return trial

    def gain(at: _Run, trial: _Run) -> float | None:
        return (at.cost - trial.cost) / max(at.cost, 1e-300) if trial.cost <= at.cost else None

    if start is None:
        rough = equation_error(target, drive, rows, order)[1]
        start = _steiglitz_mcbride(target, drive, rows, order, stable(rough), lambda a: solve(a).cost)
    search = Search(DAMPING, trials, gain, lambda gained, _step: not gained > 1e-9)
    optimum = descend(search, solve(start), max_steps if poles else 0)[0]
    theta, count, free = optimum.theta, int(rows.sum()), poles + zeros + 2
    bic = count * np.log(max(optimum.cost / count, 1e-300)) + free * np.log(count)
    return OutputError(theta[:-1], optimum.a, delay, float(bic))


def _steiglitz_mcbride(
    target: np.ndarray,
    drive: np.ndarray,
    rows: np.ndarray,
    order: tuple[int, int, int],
    a: np.ndarray,
    cost_of: Callable[[np.ndarray], float],
) -> np.ndarray:
    """Repeated equation error of signals filtered by 1/A, which removes most of the bias of (25)."""
    best, best_cost = a, np.inf
    for _ in range(12):
        y, u, ones = (recursion(a, signal.copy()) for signal in (target, drive, np.ones(drive.size)))
        columns = np.stack([*_regressors(u, y, order), ones], axis=1)
        theta = np.linalg.lstsq(columns[rows], y[rows], rcond=None)[0]
        a = stable(np.r_[1.0, theta[order[1] + 1 : -1]])
        cost = cost_of(a)
        if not cost < best_cost * (1 - 1e-6):
            break
        best, best_cost = a, cost
    return best


def choose_order(
    torque: np.ndarray, drive: np.ndarray, rows: np.ndarray, earliest: int
) -> tuple[OutputError, list[str]]:
    """(l, n, d) with the smallest BIC among l = 1 … 3 poles, n = l - 1 zeros and a few delays, with the reasons.

    `earliest` is the smallest possible delay: 1 for a sample taken at the pulse, 0 for means over the interval; the
    rest is as for `output_error`.
    """
    tried: dict[tuple[int, int, int], OutputError] = {}
    for poles in (1, 2, 3):
        zeros = poles - 1
        for delay in range(earliest, earliest + MAX_DELAYS):
            tried[poles, zeros, delay] = output_error(torque, drive, rows, (poles, zeros, delay))
            better = [fit.bic for (p, _, d), fit in tried.items() if p == poles and d < delay]
            if better and tried[poles, zeros, delay].bic > min(better) + 10:
                break
    best = min(tried, key=lambda order: tried[order].bic)
    reasons = []
    for poles in (1, 2, 3):
        order = min((o for o in tried if o[0] == poles), key=lambda o: tried[o].bic)
        gap = tried[order].bic - tried[best].bic
        word = "chosen" if order == best else f"BIC {gap:.0f} worse"
        reasons.append(f"(l, n, d) = {order}: {word}")
    return tried[best], reasons


def general(
    method_id: str,
    grid: Grid,
    prbs: np.ndarray,
    ramp: np.ndarray,
    iterations: int,
    knots: int,
    order: str | tuple[int, int, int],
    literal: bool = False,
    inverse: bool = False,
) -> Model:
    """Two stages with the linear part of equations (1) to (3)."""
    centre = float(np.mean(grid.fraction))
    earliest = 1 if centre < 1e-6 else 0
    torque, reasons = np.nan_to_num(grid.torque_nm - quiet_level(grid)), []
    drive = straight_drive(grid, prbs) if prbs is not ramp else joint_drive(grid, prbs)
    fitted = near_rest(grid, prbs)

    def linear_part(drive: np.ndarray, rows: np.ndarray, requested: str | tuple[int, int, int]) -> OutputError:
        drive = grid.interval_means(drive)
        if literal:
            chosen = requested if isinstance(requested, tuple) else (2, 1, 1)
            b, a = equation_error(torque, drive, rows, chosen)
            gain_free = output_error(torque, drive, rows, chosen, start=stable(a), max_steps=0)
            return replace(gain_free, b=b, a=stable(a), bic=0.0)
        if isinstance(requested, tuple):
            return output_error(torque, drive, rows, requested)
        best, why = choose_order(torque, drive, rows, earliest)
        reasons.extend(why)
        return best

    linear_fit = linear_part(drive, fitted, order)
    chosen = (len(linear_fit.a) - 1, len(linear_fit.b) - 1, linear_fit.delay_samples)
    rows = near_rest(grid, ramp)
    both = fitted | rows
    curve = _curve_through(grid, torque, linear_fit.block(grid.step_s, centre), rows, knots, inverse)
    for _ in range(iterations):
        linear_fit = linear_part(curve(grid.pulse_width_us), both, chosen)
        curve = _curve_through(grid, torque, linear_fit.block(grid.step_s, centre), rows, knots, inverse)
    reasons.append(f"linear part (l, n, d) = {chosen}")
    return finish_discrete(method_id, grid, both, linear_fit.block(grid.step_s, centre), curve, reasons)


def straight_drive(grid: Grid, prbs: np.ndarray) -> np.ndarray:
    """Drive of the preliminary experiment: proportional to the pulse width (15)."""
    widths = grid.pulse_width_us[prbs]
    if not np.ptp(widths) > 0:
        raise NotIdentifiable("the pulse width never changes in the segment for the dynamics", fix="Record a PRBS.")
    return grid.pulse_width_us / float(np.max(widths))


def joint_drive(grid: Grid, rows: np.ndarray) -> np.ndarray:
    """Drive if all segments are used at once: the curve of a second-order pilot fit, scaled to a range of 1."""
    drive = pilot(grid, rows).curve(grid.pulse_width_us)
    return drive / max(float(np.ptp(drive)), 1e-300)


def _curve_through(
    grid: Grid, torque: np.ndarray, block: Discrete, rows: np.ndarray, knots: int, inverse: bool
) -> Curve:
    """The recruitment spline for a given discrete linear block: fitted to its output, or by inverting it."""
    if inverse:
        return _from_inverse(grid, torque, block, rows, knots)
    # Least squares on the output: the columns of the spline are filtered, the torque is not.
    return _penalised(grid, lambda columns: block.filter(grid.interval_means(columns))[rows], torque[rows], knots)


def _from_inverse(grid: Grid, torque: np.ndarray, block: Discrete, rows: np.ndarray, knots: int) -> Curve:
    """Equations (26) to (28) as printed: w = G⁻¹ y, then the spline by least squares on w.

    The inverse diverges if G has a zero on or outside the unit circle; it is then limited to ±1e6 N·m.
    """
    b = np.asarray(block.b) / block.b[0]
    moved = np.r_[torque[block.delay_samples :], np.zeros(block.delay_samples)]
    driven = np.convolve(moved, block.a)[: moved.size] / block.b[0]
    start = int(np.flatnonzero(rows)[0])
    driven[:start] = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        w = np.clip(np.nan_to_num(recursion(b, driven)), -1e6, 1e6)
    return _penalised(grid, lambda columns: grid.interval_means(columns)[rows], w[rows], knots)


def _penalised(grid: Grid, respond, target: np.ndarray, knots: int) -> Curve:
    largest = float(np.max(grid.pulse_width_us))
    basis = SplineBasis(np.linspace(0.0, largest, PILOT_KNOTS))
    roughness = spline_roughness(basis)
    curve = Curve(basis, np.zeros(basis.size))
    for last in (False, True):
        design = respond(basis.design(grid.pulse_width_us))
        gram, moment = design.T @ design, design.T @ target
        weight = choose_weight(gram, moment, float(target @ target), target.size, roughness).weight
        ridge = 1e-12 * float(np.trace(gram)) / len(gram) * np.eye(len(gram))
        curve = Curve(basis, np.linalg.solve(gram + weight * roughness + ridge, moment))
        if not last:
            u = np.linspace(0.0, largest, 201)
            first, basis = basis, SplineBasis(adapted_knots((u, curve(u)), largest, knots))
            roughness = spline_roughness(basis, (first, curve.coefficients_nm))
    return curve

"""Output-error estimate of the general linear block (l, n, d), and the choice of its order from the data.

Least squares on the equation error (25) is biased by output noise, since the regressors contain it (at 0.02 N·m and
40 Hz it gives Tω = 2.1 s instead of 0.53 s). Here the cost is (12), the error of the model's output in a free run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.identify.dynamics.linear import Discrete
from stimrig.identify.dynamics.second_order import recursion
from stimrig.identify.errors import NotIdentifiable

LARGEST_POLE = 0.9995
MOST_DELAYS = 4


@dataclass(frozen=True)
class OutputError:
    """A fitted linear block.

    Parameters
    ----------
    b, a : ndarray
        Coefficients of equations (2), (3), with the gain.
    delay_samples : int
        d.
    baseline_nm : float
        Constant in the output.
    output_nm : ndarray, shape (K,)
        Free run of the block with the baseline.
    squares : float
        Sum of squared errors over the fitted rows.
    bic : float
        Smaller is better.
    """

    b: np.ndarray
    a: np.ndarray
    delay_samples: int
    baseline_nm: float
    output_nm: np.ndarray
    squares: float
    bic: float

    @property
    def gain(self) -> float:
        """B(1)/A(1)."""
        return float(np.sum(self.b) / np.sum(self.a))

    def block(self, step_s: float, centre: float) -> Discrete:
        """The block with unit gain at DC."""
        return Discrete(tuple(self.b / self.gain), tuple(self.a), self.delay_samples, step_s, centre)


def shifted(values: np.ndarray, by: int) -> np.ndarray:
    """Values `by` rows later, from rest."""
    return np.concatenate([np.zeros(by), values[: values.size - by]]) if by else values


def stable(a: np.ndarray) -> np.ndarray:
    """A with poles outside the unit circle mirrored into it; all poles have at most the modulus 0.9995."""
    roots = np.roots(a)
    size = np.abs(roots)
    roots = np.where(size > 1, roots / np.maximum(size, 1e-12) ** 2, roots)
    roots = roots * np.minimum(1.0, LARGEST_POLE / np.maximum(np.abs(roots), 1e-12))
    return np.real(np.poly(roots))


def equation_error(
    torque: np.ndarray, drive: np.ndarray, rows: np.ndarray, order: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """(b, a) by equation (25), literally: least squares of (24) with rows of (23)."""
    zeros, poles, delay = order[1], order[0], order[2]
    columns = [shifted(drive, delay + j) for j in range(zeros + 1)] + [-shifted(torque, j) for j in range(1, poles + 1)]
    lead = max(poles, zeros + delay)
    used = rows.copy()
    for j in range(1, lead + 1):  # every regressor must have been measured
        used[j:] &= rows[:-j]
    used[:lead] = False
    theta = np.linalg.lstsq(np.stack(columns, axis=1)[used], torque[used], rcond=None)[0]
    return theta[: zeros + 1], np.r_[1.0, theta[zeros + 1 :]]


def output_error(
    torque: np.ndarray,
    drive: np.ndarray,
    rows: np.ndarray,
    order: tuple[int, int, int],
    start: np.ndarray | None = None,
    most: int = 40,
) -> OutputError:
    """Minimise (12) over b, a and a baseline, for given (l, n, d).

    Parameters
    ----------
    torque, drive : ndarray, shape (K,)
        Output and input.
    rows : ndarray of bool, shape (K,)
        Rows that are fitted.
    order : tuple of int
        (l, n, d): poles, zeros, delay.
    start : ndarray, optional
        Start for A; by default from (25), improved by the iteration of Steiglitz and McBride.

    Raises
    ------
    NotIdentifiable
        The input never changes.
    """
    poles, zeros, delay = order
    if not np.ptp(drive) > 0:
        raise NotIdentifiable("the input of the linear block never changes", fix="Record a PRBS.")
    target = np.where(rows, np.nan_to_num(torque), 0.0)

    def solve(a: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        columns = [recursion(a, shifted(drive, delay + j).copy()) for j in range(zeros + 1)]
        design = np.stack([*columns, np.ones(drive.size)], axis=1)
        theta = np.linalg.lstsq(design[rows], target[rows], rcond=None)[0]
        fitted = design @ theta
        error = (target - fitted)[rows]
        return theta, fitted, float(error @ error)

    if start is None:
        rough = equation_error(torque - _rest_level(torque, drive, rows), drive, rows, order)[1]
        a = _steiglitz_mcbride(target, drive, rows, order, stable(rough))
    else:
        a = start
    theta, fitted, cost = solve(a)
    damping = 1e-3
    for _ in range(most if poles else 0):
        inner = fitted - theta[-1]
        columns = [recursion(a, shifted(drive, delay + j).copy()) for j in range(zeros + 1)]
        slopes = [-recursion(a, shifted(inner, j).copy()) for j in range(1, poles + 1)]
        jacobian = np.stack([*slopes, *columns, np.ones(drive.size)], axis=1)[rows]
        scale = np.linalg.norm(jacobian, axis=0) + 1e-300
        jacobian /= scale
        gram, right = jacobian.T @ jacobian, jacobian.T @ (target - fitted)[rows]
        improved = False
        while damping < 1e8:
            step = np.linalg.solve(gram + damping * np.eye(len(gram)), right) / scale
            trial = stable(np.r_[1.0, a[1:] + step[:poles]])
            new = solve(trial)
            if new[2] <= cost:
                improved = cost - new[2] > 1e-9 * cost
                a, (theta, fitted, cost), damping = trial, new, max(damping / 10, 1e-12)
                break
            damping *= 10
        if not improved:
            break
    count, free = int(rows.sum()), poles + zeros + 2
    bic = count * np.log(max(cost / count, 1e-300)) + free * np.log(count)
    return OutputError(theta[:-1], a, delay, float(theta[-1]), fitted, cost, float(bic))


def _rest_level(torque: np.ndarray, drive: np.ndarray, rows: np.ndarray) -> float:
    still = rows & (drive == 0) & np.isfinite(torque)
    return float(np.percentile(torque[still], 10)) if still.any() else 0.0


def _steiglitz_mcbride(
    target: np.ndarray, drive: np.ndarray, rows: np.ndarray, order: tuple[int, int, int], a: np.ndarray
) -> np.ndarray:
    """Repeated equation error of signals filtered by 1/A, which removes most of the bias of (25)."""
    poles, zeros, delay = order
    best, best_cost = a, np.inf
    for _ in range(12):
        y = recursion(a, target.copy())
        u = recursion(a, drive.copy())
        ones = recursion(a, np.ones(drive.size))
        columns = [shifted(u, delay + j) for j in range(zeros + 1)] + [-shifted(y, j) for j in range(1, poles + 1)]
        theta = np.linalg.lstsq(np.stack([*columns, ones], axis=1)[rows], y[rows], rcond=None)[0]
        a = stable(np.r_[1.0, theta[zeros + 1 : -1]])
        drives = [recursion(a, shifted(drive, delay + j).copy()) for j in range(zeros + 1)]
        design = np.stack([*drives, np.ones(drive.size)], axis=1)[rows]
        error = target[rows] - design @ np.linalg.lstsq(design, target[rows], rcond=None)[0]
        cost = float(error @ error)
        if cost < best_cost * (1 - 1e-6):
            best, best_cost = a, cost
        else:
            break
    return best


def choose_order(
    torque: np.ndarray, drive: np.ndarray, rows: np.ndarray, earliest: int
) -> tuple[OutputError, list[str]]:
    """(l, n, d) with the smallest BIC among l = 1 … 3 poles, n = l - 1 zeros and a few delays, with the reasons.

    Parameters
    ----------
    torque, drive, rows : ndarray, shape (K,)
        As for `output_error`.
    earliest : int
        Smallest possible delay: 1 for a sample taken at the pulse, 0 for means over the interval.
    """
    tried: dict[tuple[int, int, int], OutputError] = {}
    for poles in (1, 2, 3):
        zeros = poles - 1
        for delay in range(earliest, earliest + MOST_DELAYS):
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

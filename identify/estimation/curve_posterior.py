"""Posterior of a curve that never falls, for linearised dynamics: modes, evidence of each deviation, and draws.

The data enter as a quadratic form, so nothing here needs the record. Unknowns are z = (log gain, middle, log width,
standard deviates of the curve's deviation, further parameters in which the prediction is linear). Draws follow Laplace's
approximation, but linearised in the steps and not in their logarithms: the prediction is linear in the steps, so every
draw fits the data as well as it should.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, solve_triangular

from identify.recruitment.near_shape import NearShape

STEPS = 40
"""Newton steps at most."""
ENOUGH = 0.02
"""Newton's method ends when the log posterior can rise by less."""
LARGEST_LOG = 3.0
"""No Newton step changes the log of a step of the curve by more."""


@dataclass(frozen=True)
class Quadratic:
    """The data: -2 log likelihood = x'Gx - 2 b'x + energy, with x = (steps of the curve, further parameters).

    Parameters
    ----------
    gram : ndarray, shape (N, N)
        G, of whitened rows.
    moment : ndarray, shape (N,)
        b.
    energy : float
        Sum of the whitened target's squares.
    mean, precision : ndarray, shape (N - n,), (N - n, N - n)
        Prior of the further parameters.
    """

    gram: np.ndarray
    moment: np.ndarray
    energy: float
    mean: np.ndarray
    precision: np.ndarray


@dataclass(frozen=True)
class Mode:
    """The most probable unknowns for one size of the deviation.

    Parameters
    ----------
    deviation : float
        Its standard deviation.
    z : ndarray
        Unknowns.
    log_evidence : float
        By Laplace's approximation.
    root : ndarray
        Lower Cholesky root of the information at the mode.
    """

    deviation: float
    z: np.ndarray
    log_evidence: float
    root: np.ndarray


class CurvePosterior:
    """The posterior for given data and prior.

    Parameters
    ----------
    prior : NearShape
        Of the curve.
    data : Quadratic
        Of the record.
    """

    def __init__(self, prior: NearShape, data: Quadratic) -> None:
        self.prior, self.data = prior, data
        self.n = prior.basis.size
        self.others = slice(3 + self.n, 3 + self.n + data.mean.size)
        precision = np.zeros((self.others.stop, self.others.stop))
        precision[:3, :3] = prior.precision
        precision[3 : 3 + self.n, 3 : 3 + self.n] = np.eye(self.n)
        precision[self.others, self.others] = data.precision
        self.precision = precision
        self.mean = np.r_[prior.mean, np.zeros(self.n), data.mean]

    def start(self, three: np.ndarray) -> np.ndarray:
        """Unknowns at a shape, without deviation."""
        return np.r_[three, np.zeros(self.n), self.data.mean]

    def unknown_to_linear(self, z: np.ndarray, deviation: np.ndarray | float) -> np.ndarray:
        """x = (steps, further parameters) of unknowns, shape (..., N)."""
        size = np.asarray(deviation)[..., None]
        log_steps = self.prior.log_steps(z[..., :3]) + size * (z[..., 3 : 3 + self.n] @ self.prior.root.T)
        return np.concatenate([np.exp(np.minimum(log_steps, 50.0)), z[..., self.others]], axis=-1)

    @classmethod
    def linear_of(cls, prior: NearShape, mode: Mode) -> np.ndarray:
        """x at a mode."""
        log_steps = prior.log_steps(mode.z[:3]) + mode.deviation * (prior.root @ mode.z[3 : 3 + prior.basis.size])
        return np.r_[np.exp(log_steps), mode.z[3 + prior.basis.size :]]

    def _beyond(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far the log of the plateau is from what is expected, in standard deviations, and the plateau, N·m."""
        mean, sd = self.prior.plateau
        total = np.sum(x[..., : self.n], axis=-1)
        return (np.log(total) - mean) / sd, total

    def value(self, z: np.ndarray, deviation: np.ndarray | float) -> np.ndarray:
        """Log posterior, up to a constant, shape (...)."""
        x, away = self.unknown_to_linear(z, deviation), z - self.mean
        fit = np.sum((x @ self.data.gram - 2.0 * self.data.moment) * x, axis=-1) + self.data.energy
        return -0.5 * fit - 0.5 * np.sum((away @ self.precision) * away, axis=-1) - 0.5 * self._beyond(x)[0] ** 2

    def mode(self, z: np.ndarray, deviation: float) -> Mode:
        """The mode nearest to a start, by damped Gauss-Newton steps."""
        value, damping = float(self.value(z, deviation)), 1e-4
        for _ in range(STEPS):
            gradient, information, by_z = self._bent(z, deviation)
            moved = None
            while damping < 1e8:
                step = _solve(information, gradient, damping)[0]
                # What is negligible may change as it likes.
                step = step / max(float(np.max(np.abs(by_z @ step[: 3 + self.n]))) / LARGEST_LOG, 1.0)
                trial = float(self.value(z + step, deviation))
                if trial > value - 1e-9:
                    moved = step
                    break
                damping *= 8.0
            if moved is None:
                break
            gain, z, value, damping = trial - value, z + moved, trial, max(damping / 8.0, 1e-7)
            if gain < ENOUGH:
                break
        root = _solve(self._bent(z, deviation)[1], np.zeros(z.size), 1e-9)[1]
        evidence = value + 0.5 * float(np.linalg.slogdet(self.precision)[1]) - float(np.sum(np.log(np.diag(root))))
        return Mode(deviation, z, evidence, root)

    def _slopes(self, z: np.ndarray, deviation: float) -> tuple[np.ndarray, np.ndarray]:
        """Logs of the steps, shape (n,), and their derivatives by z's first entries, shape (n, 3 + n)."""
        log_steps, (by_middle, by_width) = self.prior.log_steps_and_slopes(z[:3])
        shaped = deviation * self.prior.root
        slopes = np.concatenate([np.ones((self.n, 1)), by_middle[:, None], by_width[:, None], shaped], axis=1)
        return log_steps + shaped @ z[3 : 3 + self.n], slopes

    def _bent(self, z: np.ndarray, deviation: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient and information (positive definite) of the log posterior, and slopes of the logs that matter."""
        n = self.n
        log_steps, by_z = self._slopes(z, deviation)
        x = np.r_[np.exp(log_steps), z[self.others]]
        pull = self.data.moment - self.data.gram @ x
        slopes = np.zeros((x.size, z.size))
        slopes[:n, : 3 + n] = x[:n, None] * by_z
        slopes[n:, self.others] = np.eye(x.size - n)
        beyond, total = self._beyond(x)
        per_sd = slopes[:n].sum(axis=0) / (total * self.prior.plateau[1])
        gradient = slopes.T @ pull - self.precision @ (z - self.mean) - beyond * per_sd
        information = slopes.T @ self.data.gram @ slopes + self.precision + np.outer(per_sd, per_sd)
        return gradient, information, by_z[log_steps > log_steps.max() - 9.0]

    def modes(self, z: np.ndarray, near: Sequence[Mode] = ()) -> list[Mode]:
        """The mode for each size of the deviation, each started from the one before, or from `near`."""
        found: list[Mode] = []
        for index, deviation in enumerate(self.prior.deviations):
            if near:
                z = np.r_[near[index].z[: 3 + self.n], z[3 + self.n :]]
            elif found:
                z = z.copy()
                z[3 : 3 + self.n] *= found[-1].deviation / deviation
            found.append(self.mode(z, deviation))
            z = found[-1].z
        return found

    def draws(self, modes: Sequence[Mode], weights: np.ndarray, count: int, seed: int) -> np.ndarray:
        """Draws of x from the posterior averaged over the modes, shape (count, N); always the same for the same data."""
        rng = np.random.default_rng(seed)
        share = (np.arange(count) + 0.5) / count
        which = np.minimum(np.searchsorted(np.cumsum(weights) / np.sum(weights), share), len(modes) - 1)
        x = np.empty((count, self.data.moment.size))
        for index in np.unique(which):
            mode, rows = modes[index], which == index
            normal = rng.standard_normal((int(rows.sum()), mode.z.size))
            x[rows] = self.linear_of(self.prior, mode) + self._moved(mode, normal)
        return x

    def _moved(self, mode: Mode, normal: np.ndarray) -> np.ndarray:
        """Changes of x by unit normals, with Laplace's covariance."""
        lift = solve_triangular(mode.root, normal.T, lower=True, trans=1).T
        log_steps, by_z = self._slopes(mode.z, mode.deviation)
        steps = np.exp(log_steps) * (lift[:, : 3 + self.n] @ by_z.T)
        return np.concatenate([steps, lift[:, self.others]], axis=1)


def _solve(matrix: np.ndarray, right: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Solution of a damped positive definite system, and its lower root."""
    damped = matrix.copy()
    damped[np.diag_indices_from(damped)] *= 1.0 + damping
    root, failed = lapack.dpotrf(damped, lower=1, clean=1)  # pyright: ignore[reportAttributeAccessIssue]
    if failed:
        raise np.linalg.LinAlgError("the information is not positive definite")
    return lapack.dpotrs(root, right, lower=1)[0], root  # pyright: ignore[reportAttributeAccessIssue]



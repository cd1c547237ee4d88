"""Posterior of a curve that never falls, for linearised dynamics: modes, evidence of each deviation, and draws.

The data enter as a quadratic form, so nothing here needs the record. Unknowns are z = (log gain, middle, log width,
standard deviates of the curve's deviation, further parameters in which the prediction is linear). Draws follow the
approximation of Laplace, but linearised in the steps and not in their logarithms: the prediction is linear in the
steps, so every draw fits the data as well as it should.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, solve_triangular

from stimrig.identify.estimation.descent import Damping, Search, Trial, descend
from stimrig.identify.recruitment.near_shape import NearShape

DAMPING = Damping(first=1e-4, less=8.0, more=8.0, smallest=1e-7)
STEPS = 40
"""Newton steps at most."""
ENOUGH = 0.02
"""Newton's method ends when the log posterior can rise by less."""
LARGEST_LOG = 3.0
"""No Newton step changes the log of a step of the curve by more."""


@dataclass(frozen=True)
class Quadratic:
    """The data: -2 log likelihood = x'Gx - 2 b'x + energy, with x = (steps of the curve, further parameters)."""

    gram: np.ndarray  # G, of whitened rows, shape (N, N)
    moment: np.ndarray  # b, shape (N,)
    energy: float  # sum of the whitened target's squares
    mean: np.ndarray  # of the prior of the further parameters, shape (N - n,)
    precision: np.ndarray  # of that prior, shape (N - n, N - n)


@dataclass(frozen=True)
class Mode:
    """The most probable unknowns for one kind of deviation."""

    kind: int  # index of the kind of the curve's deviation
    z: np.ndarray  # unknowns
    log_evidence: float  # by Laplace's approximation
    root: np.ndarray  # lower Cholesky root of the information at the mode


class CurvePosterior:
    """The posterior for given data and prior. `prior`: of the curve; `data`: of the record."""

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

    def _log_steps(self, z: np.ndarray, kind: int) -> np.ndarray:
        return self.prior.log_steps(z[:3]) + self.prior.roots[kind] @ z[3 : 3 + self.n]

    def linear_of(self, mode: Mode) -> np.ndarray:
        """x at a mode."""
        return np.r_[np.exp(self._log_steps(mode.z, mode.kind)), mode.z[3 + self.n :]]

    def _beyond(self, x: np.ndarray) -> tuple[float, float]:
        """Distance of the log of the plateau from its prior mean, in standard deviations, and the plateau, N·m."""
        mean, sd = self.prior.plateau
        total = float(np.sum(x[: self.n]))
        return (float(np.log(total)) - mean) / sd, total

    def value(self, z: np.ndarray, kind: int) -> float:
        """Log posterior, up to a constant."""
        x, away = np.r_[np.exp(np.minimum(self._log_steps(z, kind), 50.0)), z[self.others]], z - self.mean
        fit = x @ (self.data.gram @ x - 2.0 * self.data.moment) + self.data.energy
        return float(-0.5 * (fit + away @ self.precision @ away + self._beyond(x)[0] ** 2))

    def mode(self, z: np.ndarray, kind: int) -> Mode:
        """The mode nearest to a start, by damped Gauss-Newton steps."""

        def trials(at: tuple[np.ndarray, float], _step: int, _damping: float) -> Trial[tuple[np.ndarray, float]]:
            gradient, information, by_z = self._bent(at[0], kind)

            def trial(damping: float) -> tuple[np.ndarray, float]:
                step = _solve(information, gradient, damping)[0]
                # What is negligible may change as it likes.
                step = step / max(float(np.max(np.abs(by_z @ step[: 3 + self.n]))) / LARGEST_LOG, 1.0)
                return at[0] + step, self.value(at[0] + step, kind)

            return trial

        def gain(at: tuple[np.ndarray, float], trial: tuple[np.ndarray, float]) -> float | None:
            return trial[1] - at[1] if trial[1] > at[1] - 1e-9 else None

        search = Search(DAMPING, trials, gain, lambda gained, _step: gained < ENOUGH)
        (z, value), _ = descend(search, (z, self.value(z, kind)), STEPS)
        root = _solve(self._bent(z, kind)[1], np.zeros(z.size), 1e-9)[1]
        evidence = value + 0.5 * float(np.linalg.slogdet(self.precision)[1]) - float(np.sum(np.log(np.diag(root))))
        return Mode(kind, z, evidence, root)

    def _slopes(self, z: np.ndarray, kind: int) -> tuple[np.ndarray, np.ndarray]:
        """Logs of the steps, shape (n,), and their derivatives by z's first entries, shape (n, 3 + n)."""
        log_steps, (by_middle, by_width) = self.prior.log_steps_and_slopes(z[:3])
        shaped = self.prior.roots[kind]
        slopes = np.concatenate([np.ones((self.n, 1)), by_middle[:, None], by_width[:, None], shaped], axis=1)
        return log_steps + shaped @ z[3 : 3 + self.n], slopes

    def _bent(self, z: np.ndarray, kind: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient and information (positive definite) of the log posterior, and slopes of the logs that matter."""
        n = self.n
        log_steps, by_z = self._slopes(z, kind)
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
        """The mode for each kind of deviation, each started from the one before, or from `near`."""
        modes: list[Mode] = []
        for kind in range(len(self.prior.deviations)):
            if near:
                z = np.r_[near[kind].z[: 3 + self.n], z[3 + self.n :]]
            elif modes:
                moved = self.prior.roots[kind - 1] @ z[3 : 3 + self.n]
                rescaled = np.asarray(solve_triangular(self.prior.roots[kind], moved, lower=True))
                # What is rough in one kind may be all but impossible in another: its share is left out.
                z = np.r_[z[:3], rescaled if rescaled @ rescaled < self.n else np.zeros(self.n), z[3 + self.n :]]
            modes.append(self.mode(z, kind))
            z = modes[-1].z
        return modes

    def draws(self, modes: Sequence[Mode], weights: np.ndarray, count: int, seed: int) -> np.ndarray:
        """Draws of x, averaged over the modes, shape (count, N); always the same for the same data."""
        rng = np.random.default_rng(seed)
        share = (np.arange(count) + 0.5) / count
        which = np.minimum(np.searchsorted(np.cumsum(weights) / np.sum(weights), share), len(modes) - 1)
        x = np.empty((count, self.data.moment.size))
        for index in np.unique(which):
            mode, rows = modes[index], which == index
            normal = rng.standard_normal((int(rows.sum()), mode.z.size))
            x[rows] = self.linear_of(mode) + self._moved(mode, normal)
        return x

    def _moved(self, mode: Mode, normal: np.ndarray) -> np.ndarray:
        """Changes of x by unit normals, with Laplace's covariance in the steps."""
        log_steps, by_z = self._slopes(mode.z, mode.kind)
        size = self.prior.blurred(np.exp(log_steps))
        slopes = np.zeros((self.n + self.data.mean.size, mode.z.size))
        slopes[: self.n, : 3 + self.n] = size[:, None] * by_z
        slopes[self.n :, self.others] = np.eye(self.data.mean.size)
        root = _solve(slopes.T @ self.data.gram @ slopes + self.precision, np.zeros(mode.z.size), 1e-9)[1]
        return np.asarray(solve_triangular(root, normal.T, lower=True, trans=1)).T @ slopes.T


def _solve(matrix: np.ndarray, right: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Solution of a damped positive definite system, and its lower root."""
    damped = matrix.copy()
    damped[np.diag_indices_from(damped)] *= 1.0 + damping
    root, failed = lapack.dpotrf(damped, lower=1, clean=1)  # type: ignore
    if failed:
        raise np.linalg.LinAlgError("the information is not positive definite")
    return lapack.dpotrs(root, right, lower=1)[0], root  # type: ignore

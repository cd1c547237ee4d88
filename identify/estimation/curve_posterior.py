"""Posterior of a curve that never falls, for linearised dynamics: modes, evidence of each deviation, and draws.

The data enter as a quadratic form, so no draw needs the record. Unknowns are z = (log gain, middle, log width, standard
deviates of the curve's deviation, further parameters in which the prediction is linear). The draws start from Laplace's
approximation at the mode of each size of the deviation, and Hamiltonian steps then make them draws of the posterior
itself (Neal 2011): where little is known, the posterior of a curve is far from normal.
"""

from __future__ import annotations

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
            gradient, information = self._bent(z, deviation)
            moved, root = None, None
            while damping < 1e8:
                step, root = _solve(information, gradient, damping)
                step = step / max(float(np.max(np.abs(self._log_change(z, step, deviation)))) / LARGEST_LOG, 1.0)
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
        _, information = self._bent(z, deviation)
        _, root = _solve(information, np.zeros(z.size), 1e-9)
        evidence = value + 0.5 * float(np.linalg.slogdet(self.precision)[1]) - float(np.sum(np.log(np.diag(root))))
        return Mode(deviation, z, evidence, root)

    def _log_change(self, z: np.ndarray, step: np.ndarray, deviation: float) -> np.ndarray:
        linear = self.prior.slopes(z[:3]) @ step[:3] + deviation * (self.prior.root @ step[3 : 3 + self.n])
        # What is negligible may change as it likes.
        log_steps = self.prior.log_steps(z[:3]) + deviation * (self.prior.root @ z[3 : 3 + self.n])
        return np.where(log_steps + linear > log_steps.max() - 9.0, linear, 0.0)

    def _bent(self, z: np.ndarray, deviation: float) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and information (positive definite) of the log posterior."""
        x = self.unknown_to_linear(z, deviation)
        n = self.n
        pull = self.data.moment - self.data.gram @ x
        slopes = np.zeros((x.size, z.size))
        slopes[:n, :3] = x[:n, None] * self.prior.slopes(z[:3])
        slopes[:n, 3 : 3 + n] = x[:n, None] * (deviation * self.prior.root)
        slopes[n:, self.others] = np.eye(x.size - n)
        beyond, total = self._beyond(x)
        per_sd = slopes[:n].sum(axis=0) / (total * self.prior.plateau[1])
        gradient = slopes.T @ pull - self.precision @ (z - self.mean) - beyond * per_sd
        return gradient, slopes.T @ self.data.gram @ slopes + self.precision + np.outer(per_sd, per_sd)

    def modes(self, z: np.ndarray) -> list[Mode]:
        """The mode for each size of the deviation, each started from the one before."""
        found = []
        for deviation in self.prior.deviations:
            if found:
                z = z.copy()
                z[3 : 3 + self.n] *= found[-1].deviation / deviation
            found.append(self.mode(z, deviation))
            z = found[-1].z
        return found

    def draws(self, modes: list[Mode], weights: np.ndarray, count: int, rounds: int, seed: int) -> np.ndarray:
        """Draws of x from the posterior averaged over the modes, shape (count, N); always the same for the same data."""
        rng = np.random.default_rng(seed)
        share = (np.arange(count) + 0.5) / count
        which = np.minimum(np.searchsorted(np.cumsum(weights) / np.sum(weights), share), len(modes) - 1)
        x = np.empty((count, self.data.moment.size))
        for index in np.unique(which):
            rows = which == index
            x[rows] = self._moved(modes[index], int(rows.sum()), rounds, rng)
        return x

    def _moved(self, mode: Mode, count: int, rounds: int, rng: np.random.Generator) -> np.ndarray:
        """Draws for one mode: Laplace's, then Hamiltonian steps in the coordinates in which that is a unit normal."""
        size = mode.z.size
        lift = solve_triangular(mode.root, np.eye(size), lower=True)  # z = mode + lift.T @ q
        q = rng.standard_normal((count, size))
        for _ in range(rounds):
            q = self._hamiltonian(mode, lift, q, rng)
        return self.unknown_to_linear(mode.z + q @ lift, mode.deviation)

    def _hamiltonian(self, mode: Mode, lift: np.ndarray, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        step, many = rng.uniform(0.16, 0.28), 7
        speed = rng.standard_normal(q.shape)
        value, gradient = self._value_and_gradient(mode, lift, q)
        energy, at, moving = value - 0.5 * np.sum(speed**2, axis=1), q, speed
        new = value
        for _ in range(many):
            moving = moving + 0.5 * step * gradient
            at = at + step * moving
            new, gradient = self._value_and_gradient(mode, lift, at)
            moving = moving + 0.5 * step * gradient
        with np.errstate(invalid="ignore"):
            gain = new - 0.5 * np.sum(moving**2, axis=1) - energy
        taken = np.log(rng.random(len(q))) < np.nan_to_num(gain, nan=-np.inf)
        self.accepted = float(np.mean(taken))
        return np.where(taken[:, None], at, q)

    def _value_and_gradient(self, mode: Mode, lift: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z, n, sd = mode.z + q @ lift, self.n, mode.deviation
        x = self.unknown_to_linear(z, sd)
        pulled = x @ self.data.gram
        away = z - self.mean
        stiff = away @ self.precision
        fit = np.sum((pulled - 2.0 * self.data.moment) * x, axis=1) + self.data.energy
        beyond, total = self._beyond(x)
        value = -0.5 * fit - 0.5 * np.sum(stiff * away, axis=1) - 0.5 * beyond**2
        pull = self.data.moment - pulled
        per_log = (pull[:, :n] - (beyond / (total * self.prior.plateau[1]))[:, None]) * x[:, :n]
        slope = np.empty_like(z)
        slope[:, 3 : 3 + n] = sd * (per_log @ self.prior.root)
        slope[:, self.others] = pull[:, n:]
        slope[:, :3] = np.sum(per_log[:, :, None] * self._slopes(z[:, :3]), axis=1)
        return value, (slope - stiff) @ lift.T

    def _slopes(self, three: np.ndarray) -> np.ndarray:
        """Derivatives of the log steps by the three, for many, shape (S, n, 3)."""
        found = np.ones((len(three), self.n, 3))
        for column, nudge in ((1, 1e-4 * np.exp(three[:, 2])), (2, np.full(len(three), 1e-4))):
            up, down = three.copy(), three.copy()
            up[:, column] += nudge
            down[:, column] -= nudge
            found[:, :, column] = (self.prior.log_steps(up) - self.prior.log_steps(down)) / (2.0 * nudge[:, None])
        return found

    def with_data(self, data: Quadratic) -> CurvePosterior:
        """The same prior with other data."""
        return CurvePosterior(self.prior, data)


def _solve(matrix: np.ndarray, right: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Solution of a damped positive definite system, and its lower root."""
    damped = matrix.copy()
    damped[np.diag_indices_from(damped)] *= 1.0 + damping
    root, failed = lapack.dpotrf(damped, lower=1, clean=1)  # pyright: ignore[reportAttributeAccessIssue]
    if failed:
        raise np.linalg.LinAlgError("the information is not positive definite")
    return lapack.dpotrs(root, right, lower=1)[0], root  # pyright: ignore[reportAttributeAccessIssue]



"""What a short record says to its fit: the torque as a quadratic form at given dynamics, its residual and its noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.dynamics.pulse_grid import Grid, ends_of
from stimrig.identify.estimation.curve_posterior import Quadratic
from stimrig.identify.estimation.earlier import Earlier
from stimrig.identify.estimation.projection import Projection
from stimrig.identify.noise.level import NoiseLevel, profile, whitened
from stimrig.identify.recruitment.spline import SplineBasis

CORRELATED = 6.0
"""Log likelihood by which correlated noise must explain the residual better before it is believed."""
LOG_T, LOG_DAMPING = (np.log(0.2), 1.2), (0.0, 0.8)
"""Prior mean and standard deviation, as in `Problem.prior`."""


class ShortData:
    """One record, with the prior of everything but the curve.

    Parameters
    ----------
    grid : Grid
        The record on the grid of pulses.
    rows : ndarray of bool, shape (K,)
        Intervals to fit.
    sign : float
        1 where stimulation raises the record's torque, -1 where it lowers it.
    last : Earlier or None
        What is known of this person from the last session.
    """

    def __init__(self, grid: Grid, rows: np.ndarray, sign: float, last: Earlier | None) -> None:
        self.grid, self.rows, self.sign = grid, rows, sign
        torque = grid.torque_nm[rows]
        scale = self.scale_nm = max(float(np.percentile(np.abs(torque - np.median(torque[:8])), 98)), 1e-9)
        each = max(float(np.median(grid.count[rows])), 1.0)
        self.first_sd_nm = max(grid.noise_sd_nm / np.sqrt(each), 1e-4 * scale)
        self.stretches = ends_of(grid.stretches(rows))
        states = grid.starts.size
        sd = np.r_[np.full(grid.begins.size, 0.5 * scale), np.tile([0.3 * scale, 2.0 * scale], states)]
        lower, upper = grid.delay_bounds_s
        dynamics_sd = np.array([LOG_T[1], LOG_DAMPING[1], max((upper - lower) / 2.0, 1e-5)])
        self.dynamics_mean = np.array([LOG_T[0], LOG_DAMPING[0], 0.0])
        self.dynamics_precision = np.diag(1.0 / dynamics_sd**2)
        if last is not None:
            self.dynamics_mean, self.dynamics_precision = last.dynamics(dynamics_sd[2])
        quiet = torque[: max(int(0.2 / grid.step_s), 4)]
        self.others_mean = np.r_[np.full(grid.begins.size, float(np.median(sign * quiet))), np.zeros(2 * states)]
        self.others_precision = np.diag(1.0 / sd**2)

    @property
    def quiet(self) -> NoiseLevel:
        """The noise of an interval's mean if it is only that of the samples."""
        return NoiseLevel(0.0, 0.0, self.first_sd_nm)

    def quadratic(self, basis: SplineBasis, linear: SecondOrder, noise: NoiseLevel, x: np.ndarray | None) -> Quadratic:
        """The quadratic form at some dynamics; with the derivatives by the dynamics if a curve is given."""
        projection = Projection(self.grid, basis, np.zeros((basis.size, basis.size)), self.rows)
        columns = projection.columns(linear)
        n = basis.size
        columns[:, :n] = np.cumsum(columns[:, :n][:, ::-1], axis=1)[:, ::-1]
        mean, precision = self.others_mean, self.others_precision
        if x is not None:
            coefficients = np.r_[np.cumsum(x[:n]), x[n : columns.shape[1]]]
            columns = np.concatenate([columns, projection.slopes(linear, coefficients)], axis=1)
            at = np.array([np.log(linear.time_constant_s), np.log(linear.damping), linear.delay_s])
            mean = np.r_[mean, self.dynamics_mean - at]
            full = np.zeros((mean.size, mean.size))
            full[: self.others_mean.size, : self.others_mean.size] = precision
            full[self.others_mean.size :, self.others_mean.size :] = self.dynamics_precision
            precision = full
        target = np.where(self.rows, self.sign * self.grid.torque_nm, 0.0)
        white = whitened(np.vstack([columns.T, target]), self.stretches, noise)
        products = white @ white.T
        return Quadratic(products[:-1, :-1], products[:-1, -1], float(products[-1, -1]), mean, precision)

    def bounded(self, linear: SecondOrder, moved: np.ndarray) -> SecondOrder:
        """Dynamics moved by changes of log T, log ζ and the delay, within their bounds."""
        t = linear.time_constant_s * float(np.exp(np.clip(moved[0], -0.7, 0.7)))
        z = linear.damping * float(np.exp(np.clip(moved[1], -0.7, 0.7)))
        return SecondOrder(t, z, linear.delay_s + float(moved[2])).bounded(self.grid.delay_bounds_s)

    def residual(self, basis: SplineBasis, linear: SecondOrder, x: np.ndarray) -> np.ndarray:
        """Measured minus model, N·m, shape (K,)."""
        projection = Projection(self.grid, basis, np.zeros((basis.size, basis.size)), self.rows)
        n = basis.size
        mean = projection.columns(linear) @ np.r_[np.cumsum(x[:n]), x[n:]]
        return np.where(self.grid.count > 0, self.sign * self.grid.torque_nm, 0.0) - mean

    def noise(self, basis: SplineBasis, linear: SecondOrder, x: np.ndarray, near: NoiseLevel) -> NoiseLevel:
        """The noise of the residual; at least that of the samples, and correlated only where that is plain."""
        residual = self.residual(basis, linear, x)
        sd = float(np.sqrt(np.mean(residual[self.rows] ** 2)))
        own = NoiseLevel(0.0, 0.0, max(sd, self.first_sd_nm))
        slow, likelihood = profile(residual, self.stretches, NoiseLevel(0.5, 0.5, near.sd_nm), True)
        flat = -0.5 * float(self.rows.sum()) * (np.log(2 * np.pi * sd * sd) + 1.0)
        return replace(slow, sd_nm=max(slow.sd_nm, own.sd_nm)) if likelihood > flat + CORRELATED else own


def direction(grid: Grid, rows: np.ndarray) -> float:
    """1 where stimulation raises the torque, -1 where it lowers it."""
    slow = SecondOrder(0.2, 0.9).on_grid(grid, grid.pulse_width_us)[rows]
    torque = grid.torque_nm[rows]
    return 1.0 if float((slow - slow.mean()) @ (torque - torque.mean())) >= 0.0 else -1.0

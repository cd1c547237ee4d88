"""A short record fitted with a curve that never falls, near a known shape: draws of the whole posterior.

A spline with a smoothness penalty needs a record that covers the curve. A short test does not: there the prior of
`recruitment.near_shape` says what is plausible between the tested widths, and the draws show how little is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stimrig.identify.dynamics.grid import Grid, ends_of
from stimrig.identify.dynamics.linear import DAMPING_BOUNDS, TIME_CONSTANT_BOUNDS_S, SecondOrder
from stimrig.identify.estimation.curve_posterior import CurvePosterior, Mode, Quadratic
from stimrig.identify.estimation.earlier import Earlier
from stimrig.identify.estimation.projection import Projection
from stimrig.identify.noise import NoiseLevel, profile, whitened
from stimrig.identify.recruitment.bases import SplineBasis
from stimrig.identify.recruitment.near_shape import (
    FINE_KNOTS,
    KNOTS,
    LOGISTIC_RISE,
    PLATEAU_LOG_SD,
    NearShape,
    dense_knots,
    logistic,
    new_person,
)


@dataclass(frozen=True)
class Short:
    """What a short record shows.

    Parameters
    ----------
    grid : Grid
        The record on the grid of pulses.
    rows : ndarray of bool, shape (K,)
        Intervals that were fitted.
    basis : SplineBasis
        Of the curve.
    sign : float
        1 where stimulation raises the record's torque, -1 where it lowers it.
    linear : SecondOrder
        The most probable dynamics.
    coefficients_nm : ndarray, shape (S, n)
        Draws of the curve's coefficients, positive as the muscle pulls, N·m.
    dynamics : ndarray, shape (S, 3)
        Draws of T, s, ζ and the delay, s.
    others_nm : ndarray, shape (S, E)
        Draws of the baselines and initial states (torque, N·m, and rate, N·m/s).
    modes : tuple of Mode
        One for each kind of the curve's deviation from the known shape.
    weights : ndarray, shape (M,)
        Their probabilities.
    noise : NoiseLevel
        Of the intervals' means.
    residual_nm : ndarray, shape (K,)
        Measured minus the most probable model, N·m.
    three : ndarray, shape (3,)
        Log gain, middle and log width at the most probable mode.
    likely : ndarray, shape (n + E,)
        Steps of the curve, baselines and initial states at the most probable mode.
    rise_us : float
        Rise from 10 to 90 % for which the knots were made, µs.
    strange : float
        Probability that the curve is far from the known shape.
    """

    grid: Grid
    rows: np.ndarray
    basis: SplineBasis
    sign: float
    linear: SecondOrder
    coefficients_nm: np.ndarray
    dynamics: np.ndarray
    others_nm: np.ndarray
    modes: tuple[Mode, ...]
    weights: np.ndarray
    noise: NoiseLevel
    residual_nm: np.ndarray
    three: np.ndarray
    likely: np.ndarray
    rise_us: float
    strange: float

    @property
    def largest_us(self) -> float:
        """Largest width of the curve, µs."""
        return self.basis.largest_us

    @cached_property
    def mean_nm(self) -> np.ndarray:
        """Mean of the curve's coefficients, N·m."""
        return self.coefficients_nm.mean(axis=0)

    @cached_property
    def plateau_nm(self) -> float:
        """The mean curve at its largest width, N·m."""
        return float(self.mean_nm[-1])


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
        self.first_sd_nm = max(grid.mean_noise_nm(rows), 1e-4 * scale)
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


DRAWS = 400
OUTER = 10
"""Largest number of times that the dynamics are linearised anew."""
SETTLED = 0.05
"""The dynamics have settled when they move by less than this share of their standard deviation."""
MIDDLING = 1
"""Index of the kind of deviation with which the dynamics are searched."""
STARTS_S = (0.08, 0.2, 0.45)
COARSE = 1.0 / 3.0
"""Power of the evidence: no kind of curve is exactly true, so none is dropped as soon as it would be if one were
(Miller and Dunson 2019)."""

STRANGE = 0.8
"""Standard deviation of the log density from which a curve counts as far from the known shape."""


@dataclass(frozen=True)
class _Start:
    """Where a search begins: dynamics, shape, noise."""

    linear: SecondOrder
    three: np.ndarray
    noise: NoiseLevel


def fit_short(
    grid: Grid,
    rows: np.ndarray,
    *,
    last: Earlier | None = None,
    before: Short | None = None,
    fine: bool = False,
    draws: int = DRAWS,
) -> Short:
    """Fit a short record.

    Parameters
    ----------
    grid : Grid
        As `prepare` makes it.
    rows : ndarray of bool, shape (K,)
        Intervals to fit.
    last : Earlier, optional
        What is known of this person from the last session.
    before : Short, optional
        The fit to a shorter part of the same record: the search starts there.
    fine : bool
        Twice the knots, for a curve with a sudden bend.
    draws : int
        Number of draws.

    Raises
    ------
    numpy.linalg.LinAlgError
        No solution is found.
    """
    data = ShortData(grid, rows, before.sign if before is not None else direction(grid, rows), last)
    known_us = [known.largest_us for known in (last, before) if known is not None]
    search = _Search(data, max([float(np.max(grid.pulse_width_us)), *known_us]), last, before, fine)
    if before is not None:
        start = _Start(before.linear, before.three, before.noise)
    elif last is not None:
        start = _Start(last.linear, last.mean, data.quiet)
    else:
        start = min((search.scan(t) for t in STARTS_S), key=lambda found: found[0])[1]
    return search.fit(start, draws)


class _Search:
    """One record and one prior."""

    def __init__(
        self, data: ShortData, largest_us: float, last: Earlier | None, before: Short | None, fine: bool
    ) -> None:
        self.data, self.largest_us, self.last, self.near = data, largest_us, last, before
        self.knots = FINE_KNOTS if fine else KNOTS

    def prior(self, three: np.ndarray) -> NearShape:
        """The prior of the curve on knots that suit a shape."""
        if self.last is not None:
            prior = self.last.curve_prior(self.largest_us, self.knots)
            self.near = self.near if self._on(prior.basis) else None
            return prior
        rise = float(np.clip(LOGISTIC_RISE * np.exp(three[2]), 0.02 * self.largest_us, 0.8 * self.largest_us))
        middle = float(np.clip(three[1], 0.0, self.largest_us))
        basis = SplineBasis(dense_knots(self.largest_us, middle, rise, self.knots))
        if self.near is not None and self._on(basis) and self._alike(middle, rise):
            basis, rise = self.near.basis, self.near.rise_us
        else:
            self.near = None
        mean, precision = new_person(self.largest_us, self.data.scale_nm)
        plateau = float(np.log(self.data.scale_nm)) + 0.1, PLATEAU_LOG_SD
        return NearShape(basis, logistic, mean, precision, plateau, rise)

    def _on(self, basis: SplineBasis) -> bool:
        """Whether the fit before this one has as many knots up to the same width."""
        near = self.near
        return near is not None and near.largest_us == self.largest_us and near.basis.size == basis.size

    def _alike(self, middle: float, rise: float) -> bool:
        """Whether the knots of the fit before this one still suit the curve."""
        assert self.near is not None
        moved = abs(middle - self.near.three[1])
        return 0.75 < rise / self.near.rise_us < 1.33 and moved < 0.25 * self.near.rise_us

    def scan(self, time_constant_s: float) -> tuple[float, _Start]:
        """The best shape for given dynamics from a coarse grid, with its cost."""
        linear = SecondOrder(time_constant_s, 0.9, 0.0)
        three = np.array([np.log(self.data.scale_nm), 0.5 * self.largest_us, np.log(self.largest_us / 6.0)])
        prior = self.prior(three)
        data = self.data.quadratic(prior.basis, linear, self.data.quiet, None)
        n = prior.basis.size
        best = (np.inf, three)
        others = data.gram[n:, n:] + data.precision
        for middle in np.linspace(0.1, 0.9, 13) * self.largest_us:
            for width in self.largest_us / np.array([100.0, 40.0, 20.0, 10.0]):
                steps = np.exp(prior.log_steps(np.array([0.0, middle, np.log(width)])))
                columns = np.zeros((data.gram.shape[0], 1 + others.shape[0]))
                columns[:n, 0], columns[n:, 1:] = steps, np.eye(others.shape[0])
                inner = columns.T @ data.gram @ columns
                inner[1:, 1:] += data.precision
                inner[0, 0] += 1e-9 * max(inner[0, 0], 1e-300)
                right = columns.T @ data.moment
                right[1:] += data.precision @ data.mean
                found = np.linalg.solve(inner, right)
                cost = -float(right @ found)
                if found[0] > 0.0 and cost < best[0]:
                    best = cost, np.array([np.log(found[0]), middle, np.log(width)])
        return best[0], _Start(linear, best[1], self.data.quiet)

    def fit(self, start: _Start, draws: int) -> Short:
        """The whole fit, from a start."""
        linear, noise, prior = start.linear, start.noise, self.prior(start.three)
        n, extras = prior.basis.size, self.data.others_mean.size
        data = self.data.quadratic(prior.basis, linear, noise, None)
        near = [] if self.near is None else list(self.near.modes)
        chosen = MIDDLING if self.near is None else int(np.argmax(self.near.weights))
        flat = CurvePosterior(prior, data)
        z = near[chosen].z[: 3 + n + extras] if near else flat.start(start.three)
        found = flat.mode(z, chosen)
        posterior, weights = flat, np.zeros(0)
        for turn in range(OUTER):
            x = CurvePosterior.linear_of(prior, found)
            posterior = CurvePosterior(prior, self.data.quadratic(prior.basis, linear, noise, x))
            found = posterior.mode(np.r_[found.z[: 3 + n + extras], np.zeros(3)], chosen)
            x = CurvePosterior.linear_of(prior, found)
            settled = bool(np.max(np.abs(x[n + extras :]) / self._sd(found)) < SETTLED)
            linear = self.data.bounded(linear, x[n + extras :])
            x = x[: n + extras]
            if not (settled or turn == OUTER - 1):
                continue
            noise = self.data.noise(prior.basis, linear, x, noise)
            posterior = CurvePosterior(prior, self.data.quadratic(prior.basis, linear, noise, x))
            near = posterior.modes(np.r_[found.z[: 3 + n + extras], np.zeros(3)], near)
            weights = _probabilities(near)
            likely = int(np.argmax(weights))
            if likely == chosen or turn == OUTER - 1:
                break
            chosen, found = likely, near[likely]
            linear = self.data.bounded(linear, found.z[-3:])
        drawn = posterior.draws(near, weights, draws, seed=draws)
        return self._short(prior, linear, noise, near, weights, drawn)

    def _sd(self, mode: Mode) -> np.ndarray:
        inverse = np.linalg.solve(mode.root, np.eye(mode.z.size)[:, -3:])
        return np.sqrt(np.maximum(np.sum(inverse**2, axis=0), 1e-18))

    def _short(
        self,
        prior: NearShape,
        linear: SecondOrder,
        noise: NoiseLevel,
        modes: list[Mode],
        weights: np.ndarray,
        drawn: np.ndarray,
    ) -> Short:
        n, extras = prior.basis.size, self.data.others_mean.size
        moved = drawn[:, n + extras :]
        dynamics = np.stack(
            [
                np.clip(linear.time_constant_s * np.exp(moved[:, 0]), *TIME_CONSTANT_BOUNDS_S),
                np.clip(linear.damping * np.exp(moved[:, 1]), *DAMPING_BOUNDS),
                np.clip(linear.delay_s + moved[:, 2], *self.data.grid.delay_bounds_s),
            ],
            axis=1,
        )
        coefficients = np.cumsum(drawn[:, :n], axis=1)
        likely = modes[int(np.argmax(weights))]
        best = CurvePosterior.linear_of(prior, likely)
        centre = self.data.bounded(linear, best[n + extras :])
        return Short(
            grid=self.data.grid,
            rows=self.data.rows,
            basis=prior.basis,
            sign=self.data.sign,
            linear=centre,
            coefficients_nm=coefficients,
            dynamics=dynamics,
            others_nm=drawn[:, n : n + extras],
            modes=tuple(modes),
            weights=weights,
            noise=noise,
            residual_nm=self.data.residual(prior.basis, centre, best[: n + extras]),
            three=likely.z[:3],
            likely=best[: n + extras],
            rise_us=prior.rise_us,
            strange=float(sum(weights[i] for i, kind in enumerate(prior.deviations) if kind.sd > STRANGE)),
        )


def _probabilities(modes: list[Mode]) -> np.ndarray:
    evidence = np.array([mode.log_evidence for mode in modes])
    weights = np.exp(COARSE * (evidence - evidence.max()))
    return weights / weights.sum()

"""A short record fitted with a curve that never falls, near a known shape: draws of the whole posterior.

A spline with a smoothness penalty needs a record that covers the curve. A short test does not: there the prior of
`recruitment.near_shape` says what is plausible between the tested widths, and the draws show how little is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from stimrig.identify.dynamics.grid import Grid, ends_of
from stimrig.identify.dynamics.linear import DAMPING_BOUNDS, TIME_CONSTANT_BOUNDS_S, SecondOrder
from stimrig.identify.estimation.curve_posterior import CurvePosterior, Mode, Quadratic
from stimrig.identify.estimation.earlier import Earlier
from stimrig.identify.estimation.solve import gram
from stimrig.identify.noise import WHITE_AND_SLOW, NoiseLevel, profile, whitened
from stimrig.identify.problem.problem import Problem
from stimrig.identify.problem.setup import Setup
from stimrig.identify.recruitment.bases import SplineBasis
from stimrig.identify.recruitment.near_shape import FINE_KNOTS, KNOTS, LOGISTIC_RISE, NearShape, dense_knots, new_person


@dataclass(frozen=True)
class Short:
    """Result of the fit to a short record."""

    grid: Grid  # the record on the grid of pulses
    rows: np.ndarray  # intervals that were fitted, bool, shape (K,)
    basis: SplineBasis  # of the curve
    sign: float  # 1 where stimulation raises the record's torque, -1 where it lowers it
    linear: SecondOrder  # the most probable dynamics
    coefficients_nm: np.ndarray  # draws of the curve's coefficients, positive as the muscle pulls, N·m, shape (S, n)
    dynamics: np.ndarray  # draws of T, s, ζ and the delay, s, shape (S, 3)
    others_nm: np.ndarray  # draws of the baselines and initial states (torque, N·m, and rate, N·m/s), shape (S, E)
    modes: tuple[Mode, ...]  # one for each kind of the curve's deviation from the known shape
    weights: np.ndarray  # their probabilities, shape (M,)
    noise: NoiseLevel  # of the intervals' means
    most_probable: np.ndarray
    """Steps of the curve, baselines and initial states at the most probable mode, shape (n + E,)."""
    rise_us: float  # rise from 10 to 90 % for which the knots were made, µs
    strange: float  # probability that the curve is far from the known shape

    @property
    def largest_us(self) -> float:
        """Largest width of the curve, µs."""
        return self.basis.largest_us

    @property
    def three(self) -> np.ndarray:
        """Log gain, middle and log width at the most probable mode."""
        return self.modes[int(np.argmax(self.weights))].z[:3]

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


def direction(grid: Grid, rows: np.ndarray) -> float:
    """1 where stimulation raises the torque, -1 where it lowers it."""
    slow = SecondOrder(0.2, 0.9).on_grid(grid, grid.pulse_width_us)[rows]
    torque = grid.torque_nm[rows]
    return 1.0 if float((slow - slow.mean()) @ (torque - torque.mean())) >= 0.0 else -1.0


def fit_short(
    grid: Grid,
    rows: np.ndarray,
    *,
    last: Earlier | None = None,
    before: Short | None = None,
    fine: bool = False,
    draws: int = DRAWS,
) -> Short:
    """Fit some intervals of a short record.

    `last`: what is known of this person from the last session. `before`: the fit to a shorter part of the same record,
    where the search starts. `fine`: twice the knots, for a curve with a sudden bend. `draws`: number of draws.

    Raises numpy.linalg.LinAlgError: no solution is found.
    """
    search = _Search(grid, rows, last, before, fine)
    if before is not None:
        return search.fit(before.linear, before.three, before.noise, draws)
    if last is not None:
        return search.fit(last.linear, last.mean, search.quiet, draws)
    _, linear, three = min((search.scan(t) for t in STARTS_S), key=lambda scanned: scanned[0])
    return search.fit(linear, three, search.quiet, draws)


class _Search:
    """One record, and the prior: of its curve, and of everything else."""

    def __init__(self, grid: Grid, rows: np.ndarray, last: Earlier | None, before: Short | None, fine: bool) -> None:
        self.grid, self.rows, self.last, self.near = grid, rows, last, before
        self.sign = before.sign if before is not None else direction(grid, rows)
        known_us = [known.largest_us for known in (last, before) if known is not None]
        self.largest_us = max([float(np.max(grid.pulse_width_us)), *known_us])
        self.knots = FINE_KNOTS if fine else KNOTS
        torque = grid.torque_nm[rows]
        scale = self.scale_nm = max(float(np.percentile(np.abs(torque - np.median(torque[:8])), 98)), 1e-9)
        self.stretches = ends_of(grid.stretches(rows))
        # The noise of an interval's mean if it is only that of the samples.
        self.quiet = NoiseLevel(0.0, 0.0, max(grid.mean_noise_nm(rows), 1e-4 * scale))
        states = grid.starts.size
        sd = np.r_[np.full(grid.begins.size, 0.5 * scale), np.tile([0.3 * scale, 2.0 * scale], states)]
        lower, upper = grid.delay_bounds_s
        dynamics_sd = np.array([LOG_T[1], LOG_DAMPING[1], max((upper - lower) / 2.0, 1e-5)])
        self.dynamics_mean = np.array([LOG_T[0], LOG_DAMPING[0], 0.0])
        self.dynamics_precision = np.diag(1.0 / dynamics_sd**2)
        if last is not None:
            self.dynamics_mean, self.dynamics_precision = last.dynamics(dynamics_sd[2])
        still = float(np.median(self.sign * torque[: max(int(0.2 / grid.step_s), 4)]))
        self.others_mean = np.r_[np.full(grid.begins.size, still), np.zeros(2 * states)]
        self.others_precision = np.diag(1.0 / sd**2)

    # ---- the record ----

    def problem(self, basis: SplineBasis) -> Problem:
        """The plain structure with a curve of this basis, in the record's own zero."""
        return Problem(
            Setup(
                grid=self.grid,
                target_nm=self.sign * self.grid.torque_nm,
                fitted=self.rows,
                basis=basis,
                scale_nm=self.scale_nm,
                noise_sd_nm=self.grid.noise_sd_nm,
                delay_bounds_s=self.grid.delay_bounds_s,
            ),
            [],
        )

    @staticmethod
    def theta(linear: SecondOrder, x: np.ndarray, size: int) -> np.ndarray:
        """Parameters of the problem, from steps of the curve, baselines and initial states."""
        return np.r_[np.log(linear.core), linear.delay_s, x[size:], np.cumsum(x[:size])]

    def quadratic(self, basis: SplineBasis, linear: SecondOrder, noise: NoiseLevel, x: np.ndarray | None) -> Quadratic:
        """The quadratic form at some dynamics; with the derivatives by the dynamics if a curve is given."""
        problem, n = self.problem(basis), basis.size
        known = np.zeros(n + self.others_mean.size) if x is None else x[: n + self.others_mean.size]
        slopes = problem.run(self.theta(linear, known, n), derivatives=True)[1]
        assert slopes is not None
        steps = np.cumsum(slopes[problem.coefficients][::-1], axis=0)[::-1]
        rows = [steps, slopes[problem.baselines.start : problem.initials.stop]]
        mean, precision = self.others_mean, self.others_precision
        if x is not None:
            rows.append(slopes[:3])
            at = np.array([np.log(linear.time_constant_s), np.log(linear.damping), linear.delay_s])
            mean = np.r_[mean, self.dynamics_mean - at]
            precision = np.asarray(block_diag(precision, self.dynamics_precision))
        target = np.where(self.rows, problem.setup.target_nm, 0.0)
        products = gram(whitened(np.vstack([*rows, target]), self.stretches, noise))
        return Quadratic(products[:-1, :-1], products[:-1, -1], float(products[-1, -1]), mean, precision)

    def moved(self, linear: SecondOrder, by: np.ndarray) -> SecondOrder:
        """Dynamics moved by changes of log T, log ζ and the delay, within their bounds."""
        t, z = (value * float(np.exp(np.clip(log, -0.7, 0.7))) for value, log in zip(linear.core, by, strict=False))
        return SecondOrder(t, z, linear.delay_s + float(by[2])).bounded(self.grid.delay_bounds_s)

    def noise(self, basis: SplineBasis, linear: SecondOrder, x: np.ndarray, near: NoiseLevel) -> NoiseLevel:
        """The noise of the residual; at least that of the samples, and correlated only where that is plain."""
        problem = self.problem(basis)
        mean = problem.run(self.theta(linear, x, basis.size))[0]
        residual = np.nan_to_num(problem.setup.target_nm) - mean
        sd = float(np.sqrt(np.mean(residual[self.rows] ** 2)))
        white = replace(self.quiet, sd_nm=max(sd, self.quiet.sd_nm))
        kind = replace(WHITE_AND_SLOW, sd_nm=near.sd_nm).of_steps(self.grid.step_s)
        slow, likelihood = profile(residual, self.stretches, kind)
        flat = -0.5 * float(self.rows.sum()) * (np.log(2 * np.pi * sd * sd) + 1.0)
        return replace(slow, sd_nm=max(slow.sd_nm, white.sd_nm)) if likelihood > flat + CORRELATED else white

    # ---- the curve ----

    def prior(self, three: np.ndarray) -> NearShape:
        if self.last is not None:
            prior = self.last.curve_prior(self.largest_us, self.knots)
            self.near = self.near if self._on(prior.basis) else None
            return prior
        rise = float(np.clip(LOGISTIC_RISE * np.exp(three[2]), 0.02 * self.largest_us, 0.8 * self.largest_us))
        middle = float(np.clip(three[1], 0.0, self.largest_us))
        basis = SplineBasis(dense_knots(self.largest_us, middle, rise, self.knots))
        if self.near is not None and self._on(basis) and self._knots_suit(middle, rise):
            basis, rise = self.near.basis, self.near.rise_us
        else:
            self.near = None
        return new_person(basis, rise, self.scale_nm)

    def _on(self, basis: SplineBasis) -> bool:
        """Return True if the fit before this one has as many knots up to the same width."""
        near = self.near
        return near is not None and near.largest_us == self.largest_us and near.basis.size == basis.size

    def _knots_suit(self, middle: float, rise: float) -> bool:
        """Return True if the knots of the fit before this one still suit the curve."""
        assert self.near is not None
        moved = abs(middle - self.near.three[1])
        return 0.75 < rise / self.near.rise_us < 1.33 and moved < 0.25 * self.near.rise_us

    # ---- the fit ----

    def scan(self, time_constant_s: float) -> tuple[float, SecondOrder, np.ndarray]:
        """The best shape for given dynamics from a coarse grid: its cost, the dynamics, the shape."""
        linear = SecondOrder(time_constant_s, 0.9, 0.0)
        three = np.array([np.log(self.scale_nm), 0.5 * self.largest_us, np.log(self.largest_us / 6.0)])
        prior = self.prior(three)
        data = self.quadratic(prior.basis, linear, self.quiet, None)
        n, best = prior.basis.size, np.inf
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
                solution = np.linalg.solve(inner, right)
                cost = -float(right @ solution)
                if solution[0] > 0.0 and cost < best:
                    best, three = cost, np.array([np.log(solution[0]), middle, np.log(width)])
        return best, linear, three

    def fit(self, linear: SecondOrder, three: np.ndarray, noise: NoiseLevel, draws: int) -> Short:
        prior = self.prior(three)
        n, extras = prior.basis.size, self.others_mean.size
        posterior = CurvePosterior(prior, self.quadratic(prior.basis, linear, noise, None))
        near = [] if self.near is None else list(self.near.modes)
        chosen = MIDDLING if self.near is None else int(np.argmax(self.near.weights))
        z = near[chosen].z[: 3 + n + extras] if near else np.r_[three, np.zeros(n), posterior.data.mean]
        mode, weights = posterior.mode(z, chosen), np.zeros(0)
        for turn in range(OUTER):
            x = posterior.linear_of(mode)
            posterior = CurvePosterior(prior, self.quadratic(prior.basis, linear, noise, x))
            mode = posterior.mode(np.r_[mode.z[: 3 + n + extras], np.zeros(3)], chosen)
            x = posterior.linear_of(mode)
            settled = bool(np.max(np.abs(x[n + extras :]) / _dynamics_sd(mode)) < SETTLED)
            linear = self.moved(linear, x[n + extras :])
            x = x[: n + extras]
            if not (settled or turn == OUTER - 1):
                continue
            noise = self.noise(prior.basis, linear, x, noise)
            posterior = CurvePosterior(prior, self.quadratic(prior.basis, linear, noise, x))
            near = posterior.modes(np.r_[mode.z[: 3 + n + extras], np.zeros(3)], near)
            evidence = np.array([other.log_evidence for other in near])
            weights = np.exp(COARSE * (evidence - evidence.max()))
            weights /= weights.sum()
            kind = int(np.argmax(weights))
            if kind == chosen or turn == OUTER - 1:
                break
            chosen, mode = kind, near[kind]
            linear = self.moved(linear, mode.z[-3:])
        samples = posterior.draws(near, weights, draws, seed=draws)
        dynamics = np.c_[np.exp(samples[:, n + extras : -1]) * linear.core, linear.delay_s + samples[:, -1]]
        lower, upper = np.array([TIME_CONSTANT_BOUNDS_S, DAMPING_BOUNDS, self.grid.delay_bounds_s]).T
        best = posterior.linear_of(near[int(np.argmax(weights))])
        return Short(
            grid=self.grid,
            rows=self.rows,
            basis=prior.basis,
            sign=self.sign,
            linear=self.moved(linear, best[n + extras :]),
            coefficients_nm=np.cumsum(samples[:, :n], axis=1),
            dynamics=np.clip(dynamics, lower, upper),
            others_nm=samples[:, n : n + extras],
            modes=tuple(near),
            weights=weights,
            noise=noise,
            most_probable=best[: n + extras],
            rise_us=prior.rise_us,
            strange=float(sum(weights[i] for i, kind in enumerate(prior.deviations) if kind.sd > STRANGE)),
        )


def _dynamics_sd(mode: Mode) -> np.ndarray:
    """Standard deviations of the three changes of the dynamics at a mode."""
    inverse = np.linalg.solve(mode.root, np.eye(mode.z.size)[:, -3:])
    return np.sqrt(np.maximum(np.sum(inverse**2, axis=0), 1e-18))

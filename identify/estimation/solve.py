"""Maximum a posteriori by Gauss-Newton on whitened residuals, with profiled noise, and the log evidence by Laplace."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numba import njit

from stimrig.identify.dynamics.grid import ends_of
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.effects import depend_on_joint, find_effect, registry
from stimrig.identify.effects.base import Form
from stimrig.identify.estimation.descent import Damping, Search, Trial, descend
from stimrig.identify.noise import NoiseLevel, band_part, profile
from stimrig.identify.problem.problem import Problem
from stimrig.identify.recruitment import Curve


@njit(cache=True, nogil=True, fastmath=True)
def gram(rows):  # pragma: no cover
    """rows @ rows.T for a few long rows, on one core: the threads of a library cost more time than they save here."""
    count, size = rows.shape
    out = np.empty((count, count))
    for i in range(count):
        for j in range(i + 1):
            total = 0.0
            for k in range(size):
                total += rows[i, k] * rows[j, k]
            out[i, j] = total
            out[j, i] = total
    return out


DAMPING = Damping(first=1e-3, less=6.0, more=8.0, smallest=1e-7, raised=1e-3, patience=6)
LARGEST_FIRST = 1e-3
"""Damping of the step by which the promised gain is judged, at most."""
HEAVY_TAILS = 10.0
"""Excess kurtosis above which a likelihood of normal innovations decides nothing: one row in a hundred may hold
a sixth of the squares."""
NEGLIGIBLE = 0.5
"""Gain of log posterior by the linear parameters below which the slopes by the others are as good as at the optimum."""
LARGEST_SLOPE = 1e100
"""A larger derivative is that of a model that runs away, and its square is none."""
OPTIMISM = 3.0
"""A run is stopped only if it stays below the floor even with this many times the gain that a parabola predicts."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A problem solved: its most probable parameters, and what follows from them. Each is a thing of its own."""

    problem: Problem  # the model's stages and parameters
    theta: np.ndarray  # parameters, on the scale on which they are varied, shape (P,)
    noise: NoiseLevel  # the most likely noise
    log_likelihood: float  # at the optimum
    log_evidence: float  # by Laplace's approximation, with the prior `Problem.prior`
    residual_nm: np.ndarray  # target minus prediction in all intervals, N·m, shape (K,)
    slopes: np.ndarray  # derivatives of the interval means by the parameters, shape (P, K)
    hessian: np.ndarray  # of minus the log posterior, shape (P, P)
    converged: bool = True  # whether the iteration ended because there was no further gain

    @property
    def freedom(self) -> float:
        """Effective number of parameters: those that the data determine, not the prior."""
        precision = self.problem.prior[1]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.hessian), 1e-300))
        scaled = self.hessian * scale[:, None] * scale[None, :] + 1e-12 * np.eye(scale.size)
        prior = precision * scale[:, None] * scale[None, :]
        return float(self.theta.size - np.trace(np.linalg.solve(scaled, prior)))

    @cached_property
    def excess_kurtosis(self) -> float:
        """Excess kurtosis of the innovations: 0 if they are normal; large if a few jumps hold most of the squares."""
        white = self.problem.setup.whitened(self.residual_nm[None, :], self.noise)[0]
        return float(np.mean(white**4) / max(np.mean(white**2) ** 2, 1e-300) - 3.0)

    @cached_property
    def projector(self) -> tuple[np.ndarray, np.ndarray]:
        """Whitened slopes, each over the root of its information, and the lower root of the scaled information."""
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.hessian), 1e-300))
        scaled = self.hessian * scale[:, None] * scale[None, :] + 1e-9 * np.eye(scale.size)
        return self.problem.setup.whitened(self.slopes * scale[:, None], self.noise), np.linalg.cholesky(scaled)

    @property
    def heavy_tails(self) -> bool:
        """True if a few jumps hold most of the innovations' squares."""
        return self.excess_kurtosis > HEAVY_TAILS

    @property
    def distrusted(self) -> bool:
        """True if its likelihood cannot be used as evidence."""
        return self.noise.at_bound or self.heavy_tails

    @property
    def effects(self) -> list[tuple[str, Form]]:
        """Effects and their forms."""
        return self.problem.effects

    @property
    def physical(self) -> np.ndarray:
        """Parameters in their units."""
        return self.problem.physical(self.theta)

    @property
    def linear(self) -> SecondOrder:
        """The dynamics of the plain structure."""
        return SecondOrder(*(float(value) for value in self.physical[:3]))

    @property
    def curve(self) -> Curve:
        """The recruitment curve, positive as the set-up's target."""
        return Curve(self.problem.setup.basis, self.theta[self.problem.coefficients])

    @property
    def rms_nm(self) -> float:
        """Root mean square of the residual in the fitted intervals, N·m."""
        return float(np.sqrt(np.mean(self.residual_nm[self.problem.setup.fitted] ** 2)))

    def parameters_of(self, effect: str) -> dict[str, float]:
        """An effect's parameters by name."""
        values = self.physical
        for chosen in self.problem.chosen:
            if chosen.effect == effect:
                return {p.name: float(values[i]) for i, p in zip(chosen.places, chosen.parameters, strict=True)}
        return {}

    @cached_property
    def unpredictable_torque(self) -> dict[str, tuple[float, float]]:
        """As `stimrig.identify.problem.predict.unpredictable_torque`."""
        problem, grid = self.problem, self.problem.setup.grid
        rows = self.problem.setup.fitted[grid.interval] & ~grid.record.held_out & grid.counted
        sizes = {}
        for effect in (find_effect(name) for name, _ in self.effects):
            if not effect.predictable:
                added_nm = problem.at_samples(self.theta) - problem.at_samples(self.theta, frozenset([effect.id]))
                mean = 0.0 if effect.sporadic else float(np.mean(added_nm[rows]))
                sizes[effect.id] = mean, float(np.sqrt(np.mean(added_nm[rows] ** 2)))
        return sizes

    @cached_property
    def written(self) -> Fitted:
        """With the narrow band of its noise written as the effect `tremor`; itself without a band."""
        return band_as_effect(self)


Result = TypeVar("Result")


def once(compute: Callable[[Fitted], Result]) -> Callable[[Fitted], Result]:
    """Let a function compute its result once for each fit; the result is kept for as long as the fit."""
    results: WeakKeyDictionary[Fitted, Result] = WeakKeyDictionary()

    @wraps(compute)
    def result_of(fitted: Fitted) -> Result:
        if fitted not in results:
            results[fitted] = compute(fitted)
        return results[fitted]

    return result_of


def knows_joint(fitted: Fitted) -> bool:
    """Return True if an effect of the model depends on the joint."""
    return depend_on_joint(name for name, _ in fitted.effects)


def _penalty(problem: Problem, theta: np.ndarray) -> float:
    mean, precision = problem.prior
    away = theta - mean
    return 0.5 * float(away @ precision @ away)


def solve(
    problem: Problem,
    theta: np.ndarray,
    noise: NoiseLevel,
    *,
    max_steps: int = 20,
    tolerance: float = 0.02,
    floor: float | None = None,
    patience: int = 1,
    profiled: bool = True,
) -> Fitted:
    """Find the most probable parameters, from a start `theta` on the scale on which parameters are varied.

    It stops after `max_steps` steps, when the log posterior rises by less than `tolerance`, or from step `patience` on
    where the log evidence `floor` is out of reach. `profiled`: the noise is estimated at each step, from `noise` on;
    else it stays as given.
    """
    noise = noise.of_steps(problem.setup.grid.step_s)
    start = _at(problem, np.clip(theta, problem.lower, problem.upper), noise, wide=True, profiled=profiled)
    assert start is not None

    def trials(at: Point, step: int, damping: float) -> Trial[Point] | None:
        first = min(damping, LARGEST_FIRST)
        change, shortened = newton_step(at, first)
        # Gain of the whole step if the log posterior were a parabola; later steps do what a shortened one leaves.
        promised = 0.5 * float(at.gradient @ change) * shortened
        # The start of an effect may be a point where the gradient is zero at first.
        if (step > 1 or not problem.chosen) and promised < 0.5 * tolerance:
            return None
        # The first step predicts too little from a distant start: in a trial, a sixth of the final gain.
        if floor is not None and step >= patience and at.log_evidence + OPTIMISM * (promised + 1.0) < floor:
            return None

        def trial(damping: float) -> Point:
            moved = change if damping == first else newton_step(at, damping)[0]
            there = np.clip(at.theta + moved, problem.lower, problem.upper)
            return _at(problem, there, at.noise, profiled=profiled) or replace(at, value=-np.inf)

        return trial

    def gain(at: Point, trial: Point) -> float | None:
        return trial.value - at.value if trial.value > at.value - 1e-9 else None

    search = Search(DAMPING, trials, gain, lambda gained, step: gained < tolerance and step >= 2)
    at, steps = descend(search, start, max_steps)
    return Fitted(
        problem=problem,
        theta=at.theta,
        noise=at.noise,
        log_likelihood=at.log_likelihood,
        log_evidence=at.log_evidence,
        residual_nm=at.residual,
        slopes=at.slopes,
        hessian=at.hessian,
        converged=max_steps == 0 or steps < max_steps,
    )


@dataclass(frozen=True)
class Point:
    """A point of the search: parameters, residual, slopes, noise, log-likelihood, and log posterior (`value`)."""

    problem: Problem
    theta: np.ndarray
    residual: np.ndarray
    slopes: np.ndarray
    noise: NoiseLevel
    log_likelihood: float
    value: float

    @cached_property
    def _products(self) -> np.ndarray:
        return gram(self.problem.setup.whitened(np.vstack([self.residual, self.slopes]), self.noise))

    @cached_property
    def gradient(self) -> np.ndarray:
        mean, precision = self.problem.prior
        return self._products[0, 1:] - precision @ (self.theta - mean)

    @cached_property
    def hessian(self) -> np.ndarray:
        return self._products[1:, 1:] + self.problem.prior[1]

    @cached_property
    def log_evidence(self) -> float:
        """By Laplace's approximation."""
        return self.value - 0.5 * (float(np.linalg.slogdet(self.hessian)[1]) - self.problem.prior_log_det)


def log_posterior(problem: Problem, theta: np.ndarray, residual_nm: np.ndarray, noise: NoiseLevel) -> float:
    """Up to a constant, with the noise as given."""
    white = problem.setup.whitened(residual_nm[None, :], noise)
    return -0.5 * float(np.sum(white**2)) - _penalty(problem, theta)


def _at(
    problem: Problem, theta: np.ndarray, noise: NoiseLevel, wide: bool = False, profiled: bool = True
) -> Point | None:
    """The point with these parameters. Without effects the linear ones are solved for, given all others."""
    for attempt in (1, 2):
        mean, slopes = problem.run(theta, derivatives=True)
        if slopes is None or not (np.all(np.isfinite(mean)) and np.max(np.abs(slopes)) < LARGEST_SLOPE):
            return None
        residual = problem.setup.target_nm - mean
        if problem.chosen:
            break
        if wide and profiled and attempt == 1:
            noise = profile(residual / problem.setup.spread, problem.setup.stretches, noise)[0]
        change, gained = _linear_step(problem, theta, residual, slopes, noise)
        theta = theta.copy()
        theta[problem.linear] += change
        residual = residual - change @ slopes[problem.linear]
        if gained < NEGLIGIBLE:
            break
    if not profiled:
        value = log_posterior(problem, theta, residual, noise)
        return Point(problem, theta, residual, slopes, noise, value, value)
    level, log_likelihood = profile(residual / problem.setup.spread, problem.setup.stretches, noise, wide)
    return Point(problem, theta, residual, slopes, level, log_likelihood, log_likelihood - _penalty(problem, theta))


def _linear_step(
    problem: Problem, theta: np.ndarray, residual: np.ndarray, slopes: np.ndarray, noise: NoiseLevel
) -> tuple[np.ndarray, float]:
    """Change of the linear parameters to their best values, given all others, and the log posterior that it gains."""
    free = problem.linear
    mean, precision = problem.prior
    part = precision[np.ix_(free, free)]
    products = gram(problem.setup.whitened(np.vstack([residual, slopes[free]]), noise))
    gradient = products[0, 1:] - part @ (theta[free] - mean[free])
    best = theta[free] + solve_scaled(products[1:, 1:] + part, gradient)
    change = np.clip(best, problem.lower[free], problem.upper[free]) - theta[free]
    return change, 0.5 * float(gradient @ change)


def newton_step(at: Point, damping: float) -> tuple[np.ndarray, float]:
    """Damped Newton step, and the factor by which it was shortened. Parameters at a bound do not leave it."""
    problem, theta, gradient, hessian = at.problem, at.theta, at.gradient, at.hessian
    stuck = ((theta <= problem.lower) & (gradient < 0)) | ((theta >= problem.upper) & (gradient > 0))
    for chosen in problem.chosen:
        stuck[chosen.places.start : chosen.places.stop] |= chosen.form.fixed
    free = np.flatnonzero(~stuck)
    scale = np.sqrt(np.diag(hessian)[free])
    system = hessian[np.ix_(free, free)] / scale[:, None] / scale[None, :]
    system[np.diag_indices_from(system)] += damping
    step = np.zeros(theta.size)
    try:
        root = np.linalg.cholesky(system)
    except np.linalg.LinAlgError as error:
        raise np.linalg.LinAlgError("the information is not positive definite") from error
    step[free] = np.linalg.solve(root.T, np.linalg.solve(root, gradient[free] / scale)) / scale
    # The time constant and the damping change by a factor of 2 at most, effects by a third of their range.
    limit = np.full(theta.size, np.inf)
    limit[:2] = 0.7
    for chosen in problem.chosen:
        for place in chosen.places:
            limit[place] = (problem.upper[place] - problem.lower[place]) / 3.0
    shortened = max(float(np.max(np.abs(step) / limit)), 1.0)
    return step / shortened, shortened


def solve_scaled(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric system, scaled to a unit diagonal; a very small ridge holds what nothing shows."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * scale[:, None] * scale + 1e-12 * np.eye(scale.size)
    return (np.linalg.solve(scaled, (right.T * scale).T).T * scale).T


def start_from(problem: Problem, base: Fitted, values: dict[int, dict[str, float]]) -> np.ndarray:
    """A start for a larger problem: the solution `base` of a smaller one, and values for the additional effects.

    The effects of `base` come first in `problem.chosen`, in the same order. `values`: for each index in
    `problem.chosen`, parameters by name, in their units.
    """
    theta = np.zeros(problem.size)
    common = problem.coefficients.stop
    theta[:common] = base.theta[:common]
    old = {chosen.effect: base.parameters_of(chosen.effect) for chosen in base.problem.chosen}
    physical = problem.physical(theta)
    for index, chosen in enumerate(problem.chosen):
        known = values.get(index) or old.get(chosen.effect) or {}
        for place, p in zip(chosen.places, chosen.parameters, strict=True):
            physical[place] = np.clip(known.get(p.name, p.start[0]), p.lower, p.upper)
    for known in values.values():
        physical[0] = known.get("base.time_constant_s", physical[0])
        physical[1] = known.get("base.damping", physical[1])
    theta = problem.from_physical(physical)
    if any("base.time_constant_s" in known for known in values.values()):
        return linear_start(problem, theta, base.noise)
    return theta


def linear_start(problem: Problem, theta: np.ndarray, noise: NoiseLevel) -> np.ndarray:
    """Solve for coefficients and baseline, with all other parameters given."""
    mean, slopes = problem.run(theta, derivatives=True)
    assert slopes is not None
    result = theta.copy()
    result[problem.linear] += _linear_step(problem, theta, problem.setup.target_nm - mean, slopes, noise)[0]
    return result


def band_as_effect(fitted: Fitted) -> Fitted:
    """The candidate with the narrow band of its noise written as the effect `tremor`; unchanged without a band.

    The wave is the smoothed part of the residual that belongs to the band: a cosine and a sine whose amplitudes are
    linear between knots. It describes what was measured and cannot be predicted.
    """
    effect = next((e for e in registry().values() if e.band), None) if fitted.noise.band > 0.0 else None
    if effect is None:
        return fitted
    setup = fitted.problem.setup
    step_s, span_s = setup.grid.step_s, setup.scene.span_s
    wave = band_part(fitted.residual_nm, setup.stretches, fitted.noise)
    memory_s = fitted.noise.band_s(step_s)
    wanted = 1 if memory_s > 4 * span_s else 1 + span_s / max(0.35 * memory_s, 0.15)
    form = min(effect.forms, key=lambda f: abs(np.log(len(f.parameters) / (1 + 2 * wanted))))
    problem = Problem(setup, [*fitted.effects, (effect.id, form)])
    frequency_hz = fitted.noise.turn / (2 * np.pi * step_s)
    chosen = problem.chosen[-1]
    p = {q.name: np.zeros((1, 1)) for q in chosen.parameters} | {"frequency_hz": np.full((1, 1), frequency_hz)}
    columns = [
        np.asarray(form.call(None, p | {q.name: np.ones((1, 1))}, setup.scene)).ravel() for q in chosen.parameters[1:]
    ]
    design = np.stack(columns, axis=1)[setup.fitted]
    ridge = 1e-3 * np.trace(design.T @ design) / design.shape[1] * np.eye(design.shape[1])
    amplitude = np.linalg.solve(design.T @ design + ridge, design.T @ wave[setup.fitted])
    # The mean over an interval is smaller than the wave itself.
    amplitude = amplitude / np.sinc(frequency_hz * step_s)
    theta = np.r_[fitted.theta, np.log(frequency_hz), amplitude]
    hessian = np.zeros((problem.size, problem.size))
    hessian[: fitted.theta.size, : fitted.theta.size] = fitted.hessian
    rest = np.arange(fitted.theta.size, problem.size)
    hessian[rest, rest] = np.r_[1e6, np.full(rest.size - 1, 1.0 / max(fitted.noise.sd_nm, 1e-6) ** 2)]
    mean, slopes = problem.run(theta, derivatives=True)
    assert slopes is not None
    residual = setup.target_nm - mean
    quiet = replace(
        fitted.noise,
        band=0.0,
        share=min(fitted.noise.share / (1.0 - fitted.noise.band), 1.0),
        sd_nm=float(np.std(residual[setup.fitted])),
    )
    return replace(
        fitted, problem=problem, theta=theta, slopes=slopes, hessian=hessian, residual_nm=residual, noise=quiet
    )


def predict_fitted(fitted: Fitted) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Free-run torque of a candidate at its own record's samples, N·m, shape (N,): as fitted, and as it could have been
    foreseen; and the size of what could not.

    In held-out rows hum and a drift go on. Efforts and tremor are not what the fitted rows on either side lead to: an
    effort has its usual size there, and tremor the one that the residual shows in its band.
    """
    written = fitted.written
    problem, unpredictable = written.problem, written.unpredictable_torque
    whole = problem.at_samples(written.theta)
    if not unpredictable:
        return whole, whole, np.zeros(whole.size)
    predictable = problem.at_samples(written.theta, frozenset(unpredictable))
    predictable = predictable + sum(mean for mean, _ in unpredictable.values())
    sporadic = frozenset(name for name in unpredictable if find_effect(name).sporadic)
    lasting = problem.at_samples(written.theta, sporadic) - predictable
    usual_nm = [_tremor_held_out(fitted) if find_effect(name).band else unpredictable[name][1] for name in sporadic]
    there = np.hypot(lasting, np.linalg.norm(usual_nm))
    return whole, predictable, np.where(problem.setup.grid.record.held_out, there, whole - predictable)


def _tremor_held_out(fitted: Fitted) -> float:
    """Root mean square of the narrow band in the residual of held-out rows, N·m."""
    grid = fitted.problem.setup.grid
    rows = grid.comparable & grid.held_out
    if not rows.any():
        return 0.0
    # Estimated anew beside slow noise, in which an error of the structure is.
    residual, stretches = np.nan_to_num(fitted.residual_nm), ends_of(grid.stretches(rows))
    noise = profile(residual, stretches, fitted.noise)[0]
    wave = band_part(residual, stretches, noise)[rows]
    # The mean over an interval is smaller than the wave itself.
    return float(np.sqrt(np.mean(wave**2)) / np.sinc(noise.turn / (2 * np.pi)))

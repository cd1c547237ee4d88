"""Fit of the levels to one trial: three factors of the model, and nuisance parameters of the trial alone.

The three quantities that are tracked are stages of a simulation: they act on any model, with or without effects. Gain
and threshold may also move within a trial, in proportion to time, by `…_run` from its first to its last second; the
level is that in its middle. So may the zero of the torque.

The fit is robust: a stretch in which the torque is not the model's (a spasm, an effort) loses its weight. What is left
unexplained is correlated in time; it counts as such, so a model that fits a trial poorly learns little from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from stimrig.identify.dynamics.grid import Grid, make_grid, runs
from stimrig.identify.effects import Parameter, Scene, form
from stimrig.identify.errors import BadRecord
from stimrig.identify.estimation.averaged import positive
from stimrig.identify.model import Model
from stimrig.identify.problem.predict import problem_of
from stimrig.identify.problem.problem import Problem
from stimrig.identify.records.record import Record
from stimrig.identify.tracking.state import LEVELS, State

SHORTEST_S = 1.0
ROUNDS = 7
TRUSTED_ROUNDS = 2
"""Rounds before stretches lose weight: until then the levels may be far off."""
LOCAL_S = 0.5
"""Over which an error must be large to lose its weight."""
TAILS = 3.0
DISTURBED = 0.3
"""A stretch with a smaller weight counts as disturbed."""
MOST_ALIKE = 0.97
"""Largest correlation of neighbouring errors."""
LOOSE = np.array([0.2, 20.0, 0.2])
"""Standard deviations added to the prior of the levels in the fit of a trial, so that a jump is found."""
FAR = 1.3
"""An error so many times the expected one is looked at again from another start."""
GONE_NOT_BELOW = 0.05
"""Least gain, relative to what was expected, from which that starts."""
DRIFTS = 0.1
"""Share of the trial's torque: standard deviation of the drift of its zero from begin to end (posture, load cell)."""
NEAR = 1e-4
"""The fit is done when a step is smaller than this share of `LOOSE`."""
SHAPE = 0.003
"""Share of the largest torque: standard deviation of the error of a curve coefficient that the fit cannot estimate."""

TRIAL_SD = np.array([0.05, 2.0, 0.006])
"""Standard deviations of the parameters of a trial alone: run of log gain and threshold (µs) within it, lag (s).

The lag is the rig's: after a computer's stall one trial was 7 ms later than its neighbours, which looked like a change
of the gain by twice its band.
"""


def _along(scene: Scene) -> np.ndarray:
    """-1/2 at the first interval, 1/2 at the last."""
    return (scene.time_s - scene.time_s[0]) / max(scene.span_s, 1e-9) - 0.5


@form(
    "pulse_width",
    "w = f(u - shift) where u > 0",
    Parameter("threshold_shift_us", "µs", -200.0, 200.0),
    Parameter("threshold_run_us", "µs", -50.0, 50.0),
)
def shift(width_us: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    """Shift of the threshold."""
    shift_us = p["threshold_shift_us"] + p["threshold_run_us"] * _along(scene)
    return np.where(width_us > 0.0, np.maximum(width_us - shift_us, 0.0), width_us)


@form("gain", "w = gain · f(u)", Parameter("gain_log", "1", -3.0, 3.0), Parameter("gain_run_log", "1", -1.0, 1.0))
def gain(drive_nm: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    """Gain of the drive."""
    return drive_nm * np.exp(p["gain_log"] + p["gain_run_log"] * _along(scene))


@form("additive", "y + drift · share of time", Parameter("drift_nm", "N·m", -100.0, 100.0))
def drift(_none: None, p: dict[str, Any], scene: Scene) -> np.ndarray:
    """Drift of the zero."""
    return p["drift_nm"] * _along(scene)


def placed(model: Model, levels: np.ndarray, grid: Grid) -> tuple[Problem, np.ndarray]:
    """The approved model on a record, at such levels and curve, and its parameters.

    The first form is the gain, the last two are the shift and the drift. `levels`: log gain, threshold shift (µs), log
    time scale, and what is added to the curve's coefficients (N·m), shape (3 + n,).

    Raises BadModel: as `stimrig.identify.problem.predict.problem_of`.
    """
    log_gain, shift_us, log_time = levels[:LEVELS].tolist()
    forms = ((gain, (log_gain, 0.0)), (shift, (shift_us, 0.0)), (drift, (0.0,)))
    problem, theta = problem_of(model, grid, forms)
    theta[0] += log_time
    theta[problem.coefficients] += levels[LEVELS:]
    return problem, theta


@dataclass(frozen=True)
class TrialFit:
    """Estimate of levels and curve from one trial.

    `vector`, shape (3 + n,), is the information times the best estimate: log gain, threshold shift (µs), log time
    scale, and corrections of the coefficients of the approved curve (N·m).
    """

    vector: np.ndarray
    information: np.ndarray  # inverse of their covariance
    error_nm: float  # robust standard deviation of what is left unexplained
    expected_nm: float  # the same, as the approved model's own record leaves it
    before_nm: float  # root mean square of the error before this fit: of the model as it was expected
    torque_nm: float  # standard deviation over the trial of the torque that the fitted model predicts
    wanted_nm: float  # the same of the model as it was expected
    slope: float  # of the measured torque on the expected one: 1 if all of it came
    disturbed: tuple[tuple[float, float], ...]  # stretches that do not fit, s since the record's begin
    duration_s: float  # of the record

    @property
    def misfit(self) -> float:
        """Error of the fit over that of the approved model on its own record."""
        return self.error_nm / self.expected_nm


def curve_covariance(model: Model) -> np.ndarray:
    """Covariance of the curve's coefficients of an approved model, (N·m)², shape (n, n).

    That of the fit, for twice the standard deviation, and a little for each coefficient. With more (2 % of the largest
    torque), half of a person's fatigue was taken for an error of the curve; without it, an error of a steep curve was
    taken for a change of the gain by 30 %.
    """
    top_nm = float(np.ptp(model.recruitment.table()[1]))
    unmodelled, fitted = np.eye(model.recruitment.basis.size) * (SHAPE * top_nm) ** 2, model.curve_covariance
    return unmodelled if fitted is None else unmodelled + 4.0 * fitted


def fit_trial(model: Model, expected: State, record: Record) -> TrialFit:
    """Fit a trial, from its rest before to its rest after, from what is expected of it on.

    Raises BadModel, BadRecord: as `stimrig.identify.problem.predict.predict`; and a trial shorter than a second.
    """
    grid = make_grid(record)
    if not np.sum(grid.fitted) * grid.step_s >= SHORTEST_S:
        fix = "Play a longer trial; rows of `validate` do not count."
        raise BadRecord(f"less than {SHORTEST_S:g} s that can be used", fix=fix)
    trial, start = _Trial(model, expected, grid), expected.mean[expected.observed]
    best = first = trial.fit_from(start)
    if best.misfit > FAR:
        # After a sudden loss the fit may end where the threshold explains it badly: so much less torque came.
        share = np.clip(first.slope, GONE_NOT_BELOW, 1.0 / GONE_NOT_BELOW)
        other = trial.fit_from(start + np.r_[np.log(share), np.zeros(start.size - 1)])
        best = other if other.error_nm < best.error_nm else best
    return replace(best, before_nm=first.before_nm, wanted_nm=first.wanted_nm, slope=first.slope)


class _Trial:
    """Problem and priors of a trial's fit; the free parameters are levels and curve, then those of the trial alone."""

    def __init__(self, model: Model, expected: State, grid: Grid) -> None:
        self.grid, size = grid, expected.observed.size
        self.problem, theta = placed(model, np.zeros(size), grid)
        problem, self.theta = self.problem, theta
        gains, shifts, drifts = (problem.chosen[place].first for place in (0, -2, -1))
        curve = range(problem.coefficients.start, problem.coefficients.stop)
        trial_parameters = [gains + 1, shifts + 1, *problem.delay, *problem.baselines, drifts, *problem.initials]
        self.free = np.array([gains, shifts, 0, *curve, *trial_parameters])
        target = problem.setup.to_muscle(grid.torque_nm)[grid.fitted]
        scale_nm = max(float(np.ptp(target)), 1e-6)
        theta[list(problem.baselines)] = np.median(target[: max(4, round(0.5 / grid.step_s))])
        states = np.tile([0.1, 1.0], grid.starts.size)
        own_sd = np.r_[TRIAL_SD, np.r_[np.ones(len(problem.baselines)), DRIFTS, states] * scale_nm]
        self.target, self.own_precision = target, np.diag(1.0 / own_sd**2)
        prior = expected.covariance[np.ix_(expected.observed, expected.observed)].copy()
        prior[np.arange(LEVELS), np.arange(LEVELS)] += LOOSE**2
        self.prior = block_diag(np.linalg.inv(prior), self.own_precision)
        # What the model left on the record that it was fitted on, of an interval's mean.
        rms_nm = max(float(model.fit.get(key) or 0.0) for key in ("rms_nm", "held_out_rms_nm"))
        structure = max(rms_nm**2 - model.noise.white_sd_nm**2, 0.0)
        self.expected_nm = float(np.sqrt(structure + model.noise.block_sd_nm**2)) or 1e-3

    def fit_from(self, levels: np.ndarray) -> TrialFit:
        """Gauss and Newton's steps with weights that follow the errors, from such levels and curve."""
        grid, free, theta, size = self.grid, self.free, self.theta.copy(), levels.size
        theta[free[:size]] += levels
        start, weight, done = theta[free].copy(), np.ones(self.target.size), False
        before_nm = wanted_nm = slope = np.nan
        turn = 0
        while True:
            mean, jacobian = self.problem.run(theta, derivatives=True)
            assert jacobian is not None
            mean, lever = mean[grid.fitted], jacobian[free][:, grid.fitted]
            error = self.target - mean
            if turn == 0:
                away = mean - mean.mean()
                slope = float(away @ self.target / max(away @ away, 1e-300))
                before_nm, wanted_nm = float(np.std(error)), float(np.std(mean))
            if turn >= TRUSTED_ROUNDS:
                weight = _weights(error, round(LOCAL_S / grid.step_s))
            sd_nm, correlation = _spread(error, weight)
            precision = weight / (sd_nm**2 * (1.0 + correlation) / (1.0 - correlation))
            bend, gradient, moved = (lever * precision) @ lever.T, (lever * precision) @ error, theta[free] - start
            if done or turn == ROUNDS - 1:
                break
            step = np.linalg.solve(bend + self.prior, gradient - self.prior @ moved)
            step[:LEVELS] = np.clip(step[:LEVELS], -LOOSE, LOOSE)
            theta[free] += step
            done = turn > TRUSTED_ROUNDS and bool(np.all(np.abs(step[:LEVELS]) < NEAR * LOOSE))
            turn += 1
        # The parameters of the trial alone are marginalised; their prior mean is where the fit began.
        vector, own = bend @ moved + gradient, bend[size:, size:] + self.own_precision
        nuisance = np.linalg.solve(own, np.c_[bend[size:, :size], vector[size:]])
        information = positive(bend[:size, :size] - bend[:size, size:] @ nuisance[:, :-1])
        vector = vector[:size] - bend[:size, size:] @ nuisance[:, -1] + information @ levels
        inflation = max(1.0, sd_nm / self.expected_nm) ** 2  # a poor fit may be wrong by more than its scatter
        return TrialFit(
            vector=vector / inflation,
            information=information / inflation,
            error_nm=sd_nm,
            expected_nm=self.expected_nm,
            before_nm=before_nm,
            torque_nm=float(np.std(mean)),
            wanted_nm=wanted_nm,
            slope=slope,
            disturbed=_stretches(grid, weight),
            duration_s=grid.size * grid.step_s,
        )


def _weights(error: np.ndarray, window: int) -> np.ndarray:
    local = np.convolve(np.pad(error**2, window // 2, mode="reflect"), np.ones(window) / window, "same")
    local = local[window // 2 : window // 2 + error.size]
    typical = max(float(np.median(local)), 1e-12)
    return np.minimum(1.0, (TAILS + 4.0) / (TAILS + local / typical))


def _spread(error: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Standard deviation of the errors, and the correlation of neighbours."""
    power = float(np.sum(weight * error**2) / np.sum(weight))
    pairs = np.sqrt(weight[1:] * weight[:-1])
    correlation = float(np.sum(pairs * error[1:] * error[:-1]) / max(np.sum(pairs) * power, 1e-300))
    return float(np.sqrt(max(power, 1e-18))), float(np.clip(correlation, 0.0, MOST_ALIKE))


def _stretches(grid: Grid, weight: np.ndarray) -> tuple[tuple[float, float], ...]:
    low = np.zeros(grid.size, bool)
    low[grid.fitted] = weight < DISTURBED
    begins = grid.time_s - grid.record.time_s[0]
    return tuple((float(begins[run.start]), float(begins[run.stop - 1] + grid.step_s)) for run in runs(low))

"""What one trial says of the levels: the model is fitted to it by three factors and what no model knows beforehand.

The three quantities that are tracked are stages of a simulation: they act on any model, with or without effects. Gain
and threshold may also move within a trial, in proportion to time, by `…_run` from its first to its last second; the
level is that in its middle. So may the zero of the torque.

The fit is robust: a stretch in which the torque is not the model's (a spasm, an effort) loses its weight. What is left
unexplained is correlated in time; it counts as such, so a model that fits a trial poorly learns little from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid, make_grid, runs
from stimrig.identify.effects import Parameter, Scene, form
from stimrig.identify.errors import BadRecord
from stimrig.identify.estimation.averaged import positive
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.identify.simulation.predict import problem_of
from stimrig.identify.simulation.problem import Problem
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
"""By how much looser than expected the levels are in the fit of a trial, so that a jump is found."""
FAR = 1.3
"""An error so many times the expected one is looked at again from another start."""
GONE_NOT_BELOW = 0.05
"""Least gain, relative to what was expected, from which that starts."""
DRIFTS = 0.1
"""Of the trial's torque: standard deviation of the drift of its zero from begin to end (posture, load cell)."""
NEAR = 1e-4
"""The fit is done when a step is smaller than this share of `LOOSE`."""
SHAPE = 0.003
"""Of the largest torque: standard deviation of what is wrong in a coefficient of the curve, as no fit knows it."""

OWN = np.array([0.05, 2.0, 0.006])
"""Standard deviations of what is a trial's own: how far log gain and threshold (µs) run within it, and its lag (s).

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
    """Of the threshold."""
    shift_us = p["threshold_shift_us"] + p["threshold_run_us"] * _along(scene)
    return np.where(width_us > 0.0, np.maximum(width_us - shift_us, 0.0), width_us)


@form("gain", "w = gain · f(u)", Parameter("gain_log", "1", -3.0, 3.0), Parameter("gain_run_log", "1", -1.0, 1.0))
def gain(drive_nm: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    """Of the drive."""
    return drive_nm * np.exp(p["gain_log"] + p["gain_run_log"] * _along(scene))


@form("additive", "y + drift · share of time", Parameter("drift_nm", "N·m", -100.0, 100.0))
def drift(_none: None, p: dict[str, Any], scene: Scene) -> np.ndarray:
    """Of the zero."""
    return p["drift_nm"] * _along(scene)


def placed(model: Model, levels: np.ndarray, grid: Grid) -> tuple[Problem, np.ndarray]:
    """The approved model on a record, at such levels and curve, and its parameters.

    The first form is the gain, the last two are the shift and the drift. `levels`: log gain, threshold shift (µs), log
    time scale, and what is added to the curve's coefficients (N·m), shape (3 + n,).

    Raises BadModel: as `stimrig.identify.simulation.predict.problem_of`.
    """
    log_gain, shift_us, log_time = levels[:LEVELS].tolist()
    forms = ((gain, (log_gain, 0.0)), (shift, (shift_us, 0.0)), (drift, (0.0,)))
    problem, theta = problem_of(model, grid, forms)
    theta[0] += log_time
    theta[problem.coefficients] += levels[LEVELS:]
    return problem, theta


@dataclass(frozen=True)
class Seen:
    """What a trial says.

    `vector`, shape (3 + n,), is the information times what explains the trial best: log gain, threshold shift (µs), log
    time scale, and what is to be added to the coefficients of the approved curve (N·m).
    """

    vector: np.ndarray
    information: np.ndarray  # inverse of their covariance
    error_nm: float  # robust standard deviation of what is left unexplained
    expected_nm: float  # the same, as the approved model's own record leaves it
    before_nm: float  # root mean square of the error before this fit: of the model as it was expected
    torque_nm: float  # standard deviation over the trial of the torque that the fitted model predicts
    wanted_nm: float  # the same of the model as it was expected
    came: float  # how much of the expected torque came: slope of the measured one on it
    disturbed: tuple[tuple[float, float], ...]  # stretches that do not fit, s since the record's begin
    duration_s: float  # of the record

    @property
    def misfit(self) -> float:
        """What is left unexplained, in units of what the approved model left unexplained."""
        return self.error_nm / self.expected_nm


def curve_covariance(model: Model) -> np.ndarray:
    """How well the curve of an approved model is known: the covariance of its coefficients, (N·m)², shape (n, n).

    That of the fit, for twice the standard deviation, and a little for each coefficient. With more (2 % of the largest
    torque), half of a person's fatigue was taken for an error of the curve; without it, an error of a steep curve was
    taken for a change of the gain by 30 %.
    """
    size = model.recruitment.basis.size
    top_nm = float(np.ptp(model.recruitment.table()[1]))
    own, fitted = np.eye(size) * (SHAPE * top_nm) ** 2, model.curve_covariance
    return own if fitted is None else own + 4.0 * fitted


def look(model: Model, expected: State, record: Record) -> Seen:
    """Fit a trial, from its rest before to its rest after, from what is expected of it on.

    Raises BadModel, BadRecord: as `stimrig.identify.simulation.predict.predict`; and a trial shorter than a second.
    """
    grid = make_grid(record)
    if not np.sum(grid.fitted) * grid.step_s >= SHORTEST_S:
        fix = "Play a longer trial; rows of `validate` do not count."
        raise BadRecord(f"less than {SHORTEST_S:g} s that can be used", fix=fix)
    asked = _asked(model, expected, grid)
    start, expected_nm = expected.mean[expected.seen], _expected(model)
    first = found = _fitted(asked, start)
    if found.sd_nm > FAR * expected_nm:
        # After a sudden loss the fit may end where the threshold explains it badly: so much less torque came.
        lower = (
            start + np.r_[np.log(np.clip(first.came, GONE_NOT_BELOW, 1.0 / GONE_NOT_BELOW)), np.zeros(start.size - 1)]
        )
        other = _fitted(asked, lower)
        start, found = (lower, other) if other.sd_nm < found.sd_nm else (start, found)
    vector, information = _marginal(found, start, asked.own_sd)
    doubt = max(1.0, found.sd_nm / expected_nm) ** 2  # what fits worse than it should may err by more than it scatters
    return Seen(
        vector=vector / doubt,
        information=information / doubt,
        error_nm=found.sd_nm,
        expected_nm=expected_nm,
        before_nm=first.before_nm,
        torque_nm=found.torque_nm,
        wanted_nm=first.wanted_nm,
        came=first.came,
        disturbed=_stretches(grid, found.weight),
        duration_s=grid.size * grid.step_s,
    )


@dataclass(frozen=True)
class _Asked:
    """What is fitted to a trial: levels and curve, and behind them what is the trial's own."""

    problem: Problem
    theta: np.ndarray
    free: np.ndarray
    target: np.ndarray
    prior: np.ndarray
    own_sd: np.ndarray


def _asked(model: Model, expected: State, grid: Grid) -> _Asked:
    problem, theta = placed(model, np.zeros(expected.seen.size), grid)
    gains, shifts, drifts = (problem.chosen[place].first for place in (0, -2, -1))
    curve = range(problem.coefficients.start, problem.coefficients.stop)
    own = [gains + 1, shifts + 1, *problem.delay, *problem.baselines, drifts, *problem.initials]
    target = problem.setup.to_muscle(grid.torque_nm)
    scale_nm = max(float(np.ptp(target[grid.fitted])), 1e-6)
    theta[list(problem.baselines)] = np.median(target[grid.fitted][: max(4, round(0.5 / grid.step_s))])
    states = np.tile([0.1, 1.0], problem.setup.grid.starts.size)
    own_sd = np.r_[OWN, np.r_[np.ones(len(problem.baselines)), DRIFTS, states] * scale_nm]
    free = np.array([gains, shifts, 0, *curve, *own])
    return _Asked(problem, theta, free, target, _precision(expected, own_sd), own_sd)


@dataclass(frozen=True)
class _Fit:
    """The last round of a fit: where it was, relative to where it began, and the likelihood's slope and bend there."""

    moved: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    weight: np.ndarray
    sd_nm: float
    torque_nm: float
    before_nm: float
    wanted_nm: float
    came: float


def _fitted(asked: _Asked, levels: np.ndarray) -> _Fit:
    """Gauss and Newton's steps with weights that follow the errors, from such levels and curve."""
    problem, free, prior, target = asked.problem, asked.free, asked.prior, asked.target
    theta = asked.theta.copy()
    theta[free[: levels.size]] += levels
    grid, start = problem.setup.grid, theta[free].copy()
    rows = grid.fitted
    weight, first, done = np.ones(int(rows.sum())), None, False
    for turn in range(ROUNDS):
        mean, jacobian = problem.run(theta, derivatives=True)
        assert jacobian is not None
        error, lever = (target - mean)[rows], jacobian[free][:, rows]
        first = first or _compared(target[rows], mean[rows])
        if turn >= TRUSTED_ROUNDS:
            weight = _weights(error, round(LOCAL_S / grid.step_s))
        sd_nm, alike = _spread(error, weight)
        precision = weight / (sd_nm**2 * (1.0 + alike) / (1.0 - alike))
        bend, slope, moved = (lever * precision) @ lever.T, (lever * precision) @ error, theta[free] - start
        if done or turn == ROUNDS - 1:
            return _Fit(moved, slope, bend, weight, sd_nm, float(np.std(mean[rows])), *first)
        step = np.linalg.solve(bend + prior, slope - prior @ moved)
        step[:LEVELS] = np.clip(step[:LEVELS], -LOOSE, LOOSE)
        theta[free] += step
        done = turn > TRUSTED_ROUNDS and bool(np.all(np.abs(step[:LEVELS]) < NEAR * LOOSE))
    raise AssertionError("the last round returns")


def _compared(measured_nm: np.ndarray, expected_nm: np.ndarray) -> tuple[float, float, float]:
    """Standard deviations of the error and of what was expected; and how much of that came."""
    away = expected_nm - expected_nm.mean()
    came = float(away @ measured_nm / max(away @ away, 1e-300))
    return float(np.std(measured_nm - expected_nm)), float(np.std(expected_nm)), came


def _marginal(found: _Fit, seen: np.ndarray, own_sd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information vector and matrix on levels and curve, once what is the trial's own has taken its part."""
    told = seen.size
    joint = found.bend.copy()
    joint[told:, told:] += np.diag(1.0 / own_sd**2)
    # Relative to where the fit began: there the trial's own parameters have their prior mean.
    vector = found.bend @ found.moved + found.slope
    taken = np.linalg.solve(joint[told:, told:], np.c_[joint[told:, :told], vector[told:]])
    information = positive(joint[:told, :told] - joint[:told, told:] @ taken[:, :-1])
    return vector[:told] - joint[:told, told:] @ taken[:, -1] + information @ seen, information


def _expected(model: Model) -> float:
    """Error of an interval's mean that the model left on the record it was fitted on, N·m."""
    fit = model.fit
    rms_nm = max(float(fit.get(key) or 0.0) for key in ("rms_nm", "held_out_rms_nm"))
    structure = max(rms_nm**2 - model.noise.white_sd_nm**2, 0.0)
    return float(np.sqrt(structure + model.noise.block_sd_nm**2)) or 1e-3


def _weights(error: np.ndarray, window: int) -> np.ndarray:
    local = np.convolve(np.pad(error**2, window // 2, mode="reflect"), np.ones(window) / window, "same")
    local = local[window // 2 : window // 2 + error.size]
    typical = max(float(np.median(local)), 1e-12)
    return np.minimum(1.0, (TAILS + 4.0) / (TAILS + local / typical))


def _spread(error: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Standard deviation of the errors, and the correlation of neighbours."""
    power = float(np.sum(weight * error**2) / np.sum(weight))
    pairs = np.sqrt(weight[1:] * weight[:-1])
    alike = float(np.sum(pairs * error[1:] * error[:-1]) / max(np.sum(pairs) * power, 1e-300))
    return float(np.sqrt(max(power, 1e-18))), float(np.clip(alike, 0.0, MOST_ALIKE))


def _precision(expected: State, own_sd: np.ndarray) -> np.ndarray:
    """Prior precision of the fit: levels, looser than expected, so that a jump is found; curve; the trial's own."""
    seen = expected.covariance[np.ix_(expected.seen, expected.seen)].copy()
    seen[np.arange(LEVELS), np.arange(LEVELS)] += LOOSE**2
    size = len(seen)
    precision = np.zeros((size + own_sd.size,) * 2)
    precision[:size, :size] = np.linalg.inv(seen)
    precision[size:, size:] = np.diag(1.0 / own_sd**2)
    return precision


def _stretches(grid: Grid, weight: np.ndarray) -> tuple[tuple[float, float], ...]:
    low = np.zeros(grid.size, bool)
    low[grid.fitted] = weight < DISTURBED
    begins = grid.time_s - grid.record.time_s[0]
    return tuple((float(begins[run.start]), float(begins[run.stop - 1] + grid.step_s)) for run in runs(low))

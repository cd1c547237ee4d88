"""What one trial says of the levels: the model is fitted to it by three factors and what no model knows beforehand.

The fit is robust: a stretch in which the torque is not the model's (a spasm, an effort) loses its weight. What is left
unexplained is correlated in time; it counts as such, so a model that fits a trial poorly learns little from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identify.dynamics.make_grid import make_grid
from identify.dynamics.pulse_grid import Grid, runs
from identify.model import Model
from identify.records.record import Record
from identify.simulation.predict import problem_of
from identify.tracking.forms import GAIN, SHIFT
from identify.tracking.state import LEVELS, Values

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
LOOSE = np.array([0.4, 40.0, 0.4])
"""Standard deviations that keep the fit of a trial that tells little in place."""

RUN = np.array([0.05, 2.0])
"""Standard deviations of how far the log gain and the threshold (µs) run within a trial."""


@dataclass(frozen=True)
class Seen:
    """What a trial says.

    Parameters
    ----------
    levels : ndarray, shape (3,)
        Log gain, threshold shift (µs) and log time scale that explain it best.
    information : ndarray, shape (3, 3)
        Inverse of their covariance.
    error_nm : float
        Robust standard deviation of what is left unexplained, N·m.
    expected_nm : float
        The same, as the approved model's own record leaves it, N·m.
    before_nm : float
        Root mean square of the error before this fit, N·m: of the model as it was expected.
    torque_nm : float
        Root mean square of the torque that the model predicts, N·m.
    disturbed : tuple of (float, float)
        Begin and end of the stretches that do not fit, s in the record's time.
    """

    levels: np.ndarray
    information: np.ndarray
    error_nm: float
    expected_nm: float
    before_nm: float
    torque_nm: float
    disturbed: tuple[tuple[float, float], ...]

    @property
    def misfit(self) -> float:
        """What is left unexplained, in units of what the approved model left unexplained."""
        return self.error_nm / self.expected_nm

    def sd(self) -> np.ndarray:
        """Standard deviations of the levels, infinite where the trial tells nothing; shape (3,)."""
        return np.sqrt(1.0 / np.maximum(np.linalg.eigvalsh(self.information), 1e-300))


def look(model: Model, expected: Values, record: Record) -> Seen:
    """Fit a trial.

    Parameters
    ----------
    model : Model
        The approved one, with second-order dynamics.
    expected : Values
        Where the fit begins.
    record : Record
        The trial, from its rest before to its rest after.

    Raises
    ------
    BadModel, BadRecord
        As `identify.simulation.predict.predict`.
    """
    grid = make_grid(record)
    further = ((SHIFT, (expected.threshold_shift_us, 0.0)), (GAIN, (float(np.log(expected.gain)), 0.0)))
    problem, theta = problem_of(model, grid, further)
    shift, gain = problem.chosen[-2].first, problem.chosen[-1].first
    theta[0] += np.log(expected.time_scale)
    moved = [gain, shift, 0]  # log gain, shift, log time scale
    own = [gain + 1, shift + 1, *problem.baselines, *problem.initials]
    free = np.array([*moved, *own])
    rows = grid.fitted
    target = problem.setup.to_muscle(grid.torque_nm)
    scale_nm = max(float(np.ptp(target[rows])), 1e-6)
    theta[list(problem.baselines)] = np.median(target[rows][: max(4, round(0.5 / grid.step_s))])
    start = theta[free].copy()
    loose = np.r_[
        LOOSE, RUN, np.full(len(problem.baselines), scale_nm), np.tile([0.1, 1.0], problem.setup.starts.size) * scale_nm
    ]
    weight = np.ones(int(rows.sum()))
    before_nm = 0.0
    for turn in range(ROUNDS):
        mean, jacobian = problem.run(theta, derivatives=True)
        assert jacobian is not None
        error = (target - mean)[rows]
        slope = jacobian[free][:, rows]
        if turn == 0:
            before_nm = float(np.sqrt(np.mean((error - np.median(error)) ** 2)))
        if turn >= TRUSTED_ROUNDS:
            weight = _weights(error, round(LOCAL_S / grid.step_s))
        sd_nm, alike = _spread(error, weight)
        precision = weight / (sd_nm**2 * (1.0 + alike) / (1.0 - alike))
        known = (slope * precision) @ slope.T
        pull = (slope * precision) @ error + (start - theta[free]) / loose**2
        step = np.linalg.solve(known + np.diag(1.0 / loose**2), pull)
        step[:LEVELS] = np.clip(step[:LEVELS], -0.5 * LOOSE, 0.5 * LOOSE)
        theta[free] += step
        if turn > TRUSTED_ROUNDS and np.all(np.abs(step[:LEVELS]) < 1e-4 * LOOSE):
            break
    information = _without(known + np.diag(np.r_[np.zeros(LEVELS), 1.0 / loose[LEVELS:] ** 2]))
    levels = np.array([theta[moved[0]], theta[moved[1]], theta[0] - np.log(model.linear.time_constant_s)])  # pyright: ignore
    levels = levels + np.linalg.lstsq(information, (levels - expected.levels) / LOOSE**2, rcond=1e-9)[0]
    expected_nm = _expected(model)
    return Seen(
        levels=levels,
        # What fits worse than it should may err by more than its own scatter says.
        information=information / max(1.0, sd_nm / expected_nm) ** 2,
        error_nm=sd_nm,
        expected_nm=expected_nm,
        before_nm=before_nm,
        torque_nm=float(np.sqrt(np.mean((mean[rows] - np.median(mean[rows][:4])) ** 2))),
        disturbed=_stretches(grid, rows, weight),
    )


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


def _without(known: np.ndarray) -> np.ndarray:
    """Information on the levels once the baseline and the initial state have taken theirs."""
    cross = known[:LEVELS, LEVELS:]
    left = known[:LEVELS, :LEVELS] - cross @ np.linalg.solve(known[LEVELS:, LEVELS:], cross.T)
    values, vectors = np.linalg.eigh(0.5 * (left + left.T))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def _stretches(grid: Grid, rows: np.ndarray, weight: np.ndarray) -> tuple[tuple[float, float], ...]:
    low = np.zeros(grid.size, bool)
    low[rows] = weight < DISTURBED
    begins = grid.time_s - grid.record.time_s[0]
    return tuple((float(begins[run.start]), float(begins[run.stop - 1] + grid.step_s)) for run in runs(low))

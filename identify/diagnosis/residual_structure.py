"""Whether structure is left in a residual: the residual at work, compared with that at rest and with the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.identify.diagnosis.thresholds import COUNTS, QUIET, STRUCTURE, STRUCTURE_SHARE
from stimrig.identify.dynamics.grid import ends_of, runs
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.noise import band_part
from stimrig.identify.noise.kernels import profile_noise
from stimrig.identify.records.record import Record


@dataclass(frozen=True)
class ResidualStructure:
    """What the residual of one model shows.

    Parameters
    ----------
    white_nm : float
        Standard deviation that white noise of the samples alone gives an interval's mean, N·m.
    busy_nm : float
        Residual while the muscle works, N·m.
    ratio : float
        Log-likelihood gained if rest and work each have their own noise: large if structure appears at work.
    ideal : float
        Log-likelihood if the noise were everywhere as it is at rest.
    slow_nm : float
        Standard deviation of the slow part of the residual, N·m.
    ar1 : float
        Correlation of neighbours of the residual as a whole.
    scale_nm : float
        The record's largest torque, N·m.
    """

    white_nm: float
    busy_nm: float
    ratio: float
    ideal: float
    slow_nm: float
    ar1: float
    scale_nm: float

    @property
    def left(self) -> bool:
        """Whether work and rest differ, and by as much as matters: enough samples make every trifle significant."""
        excess_nm = max(self.busy_nm**2 - self.white_nm**2, 0.0) ** 0.5
        return self.ratio > STRUCTURE and excess_nm > STRUCTURE_SHARE * self.scale_nm


def residual_structure(fitted: Fitted, quiet: np.ndarray, noise_sd_nm: float) -> ResidualStructure:
    """Compare a model's residual at work and at rest.

    Parameters
    ----------
    fitted : Fitted
        The model.
    quiet : ndarray of bool, shape (K,)
        Intervals in which the muscle rests.
    noise_sd_nm : float
        White noise of a sample, N·m.
    """
    setup = fitted.problem.setup
    residual = fitted.residual_nm - band_part(fitted.residual_nm, setup.stretches, fitted.noise)
    count = float(np.median(setup.grid.count[setup.fitted]))
    white = max(noise_sd_nm / np.sqrt(count), 1e-6 * setup.scale_nm)
    rests, works = _long(setup.fitted & quiet, 8), _long(setup.fitted & ~quiet, 4)
    together = _profile(residual, rests + works)
    resting, working = _profile(residual, rests), _profile(residual, works)
    ratio = resting[3] + working[3] - together[3] if rests and works else 0.0
    lag = _lag_one(residual, setup.fitted)
    return ResidualStructure(
        white_nm=white,
        busy_nm=_rms(residual, works),
        ratio=ratio,
        ideal=_ideal(setup.fitted, resting, white, sum(r.stop - r.start for r in rests)),
        slow_nm=fitted.noise.sd_nm * float(np.sqrt(min(fitted.noise.share, 1.0))),
        ar1=lag,
        scale_nm=setup.scale_nm,
    )


def _ideal(fitted: np.ndarray, resting: tuple, white: float, size: int) -> float:
    """Log-likelihood of a record of this length if its noise were everywhere as it is at rest."""
    total = int(fitted.sum())
    at_white = -0.5 * total * (np.log(2 * np.pi * white * white) + 1.0)
    if size < 40:
        return at_white
    return min(at_white, resting[3] / size * total)


def _long(flags: np.ndarray, least: int) -> list[slice]:
    return [run for run in runs(flags) if run.stop - run.start >= least]


def _profile(residual: np.ndarray, parts: list[slice]) -> tuple[float, float, float, float]:
    if not parts:
        return (0.0, 0.0, 0.0, 0.0)
    return profile_noise(residual, *ends_of(parts), 0.5, 0.5, True)


def _rms(residual: np.ndarray, parts: list[slice]) -> float:
    if not parts:
        return 0.0
    return float(np.sqrt(np.mean(np.concatenate([residual[p] for p in parts]) ** 2)))


def _lag_one(residual: np.ndarray, fitted: np.ndarray) -> float:
    pairs = fitted[1:] & fitted[:-1]
    a, b = residual[1:][pairs], residual[:-1][pairs]
    return float(a @ b / max(a @ a, 1e-30))


def quiet_rows(fitted: Fitted) -> np.ndarray:
    """bool, shape (K,): intervals in which the muscle rests, according to the model."""
    setup = fitted.problem.setup
    problem, physical = fitted.problem, fitted.physical
    part = setup.part_of(at_samples=False)
    baseline = physical[problem.baselines.start : problem.baselines.stop]
    torque = problem.run(fitted.theta)[0] - (baseline[0] if part is None else baseline[part])
    drive = setup.grid.held(physical[problem.coefficients] @ setup.design)
    level = QUIET * setup.scale_nm
    still = (np.abs(torque) < level) & (np.abs(drive) < level)
    # The half second after the last torque counts as work: slow tails belong to it.
    tail = round(0.5 / setup.grid.step_s)
    busy = np.convolve(~still, np.r_[np.zeros(tail), np.ones(tail + 1)], "same") > 0
    return still & ~busy


def held_readings(record: Record) -> float:
    """Share of samples equal to the one before; 0 where coarse rounding of a quiet signal explains it."""
    torque = record.torque_nm
    change = np.abs(np.diff(torque[(torque > torque.min()) & (torque < torque.max())]))
    moved = change[change > 1e-9 * max(float(np.ptp(torque)), 1e-300)]
    if change.size < 100 or not moved.size or np.median(moved) < COUNTS * np.min(moved):
        return 0.0  # it changes by single counts of the converter: between two of them it repeats
    return float(np.mean(change == 0.0))

"""The residual of a model: at work compared with at rest, and on held-out pulses with what noise allows there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.thresholds import FORM_ERROR, LEAST_HELD_OUT_ROWS, NEXT_MARGIN, QUIET
from stimrig.identify.dynamics.grid import ends_of, runs
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.left_out import FLOOR_SHARE, difference, hold_out
from stimrig.identify.estimation.solve import Fitted
from stimrig.identify.noise import WHITE_AND_SLOW, NoiseLevel, band_part, profile

LEAST_RESTING = 40
"""Fewer intervals at rest do not show how large the noise is."""
MEDIAN = 0.6745
"""Median of the size of normal errors over their standard deviation."""


@dataclass(frozen=True)
class ResidualStructure:
    """Residual of one model at work and at rest; all but log-likelihoods in N·m."""

    white_nm: float  # standard deviation that white noise of the samples alone gives an interval's mean
    busy_nm: float  # residual while the muscle works
    ratio: float  # log-likelihood gained if rest and work each have their own noise: large if structure appears at work
    ideal: float  # log-likelihood if the noise were everywhere as it is at rest
    scale_nm: float  # the record's largest torque

    @property
    def significant(self) -> bool:
        """True if work and rest differ statistically and by an amount that matters: in a long record every trifle is
        significant."""
        excess_nm = max(self.busy_nm**2 - self.white_nm**2, 0.0) ** 0.5
        return self.ratio > NEXT_MARGIN and excess_nm > FLOOR_SHARE * self.scale_nm


def residual_structure(fitted: Fitted, quiet: np.ndarray) -> ResidualStructure:
    """Compare a model's residual at work and at rest: `quiet`, bool, shape (K,), are intervals in which it rests."""
    setup = fitted.problem.setup
    residual = fitted.residual_nm - band_part(fitted.residual_nm, setup.stretches, fitted.noise)
    white = max(setup.grid.mean_noise_nm(setup.fitted), 1e-6 * setup.scale_nm)
    rests, works = _long(setup.fitted & quiet, 8), _long(setup.fitted & ~quiet, 4)
    noise = WHITE_AND_SLOW.of_steps(setup.grid.step_s)
    at_rest, at_work = (_log_likelihood(residual, parts, noise) for parts in (rests, works))
    total, resting = int(setup.fitted.sum()), sum(run.stop - run.start for run in rests)
    ideal = -0.5 * total * (np.log(2 * np.pi * white * white) + 1.0)
    if resting >= LEAST_RESTING:
        ideal = min(ideal, at_rest / resting * total)
    work = np.concatenate([residual[run] for run in works]) if works else np.zeros(1)
    return ResidualStructure(
        white_nm=white,
        busy_nm=float(np.sqrt(np.mean(work**2))),
        ratio=at_rest + at_work - _log_likelihood(residual, rests + works, noise) if rests and works else 0.0,
        ideal=ideal,
        scale_nm=setup.scale_nm,
    )


def _long(flags: np.ndarray, min_rows: int) -> list[slice]:
    return [run for run in runs(flags) if run.stop - run.start >= min_rows]


def _log_likelihood(residual: np.ndarray, parts: list[slice], kind: NoiseLevel) -> float:
    """Of some rows alone, with the noise that is most likely there."""
    return profile(residual, ends_of(parts), kind)[1] if parts else 0.0


def quiet_rows(fitted: Fitted) -> np.ndarray:
    """bool, shape (K,): intervals in which the muscle rests, according to the model."""
    setup = fitted.problem.setup
    problem, physical = fitted.problem, fitted.physical
    part = setup.part_of(at_samples=False)
    baseline = physical[problem.baselines.start : problem.baselines.stop]
    torque = problem.run(fitted.theta)[0] - (baseline[0] if part is None else baseline[part])
    drive = setup.grid.interval_means(physical[problem.coefficients] @ setup.design)
    level = QUIET * setup.scale_nm
    still = (np.abs(torque) < level) & (np.abs(drive) < level)
    # The half second after the last torque counts as work: slow tails belong to it.
    tail = round(0.5 / setup.grid.step_s)
    busy = np.convolve(~still, np.r_[np.zeros(tail), np.ones(tail + 1)], "same") > 0
    return still & ~busy


@dataclass(frozen=True)
class HeldOutError:
    """The error of one model on the intervals held out, N·m."""

    rms_nm: float  # of the intervals' means
    allowed_nm: float  # that the noise of the fitted rows and the uncertainty of the parameters explain there

    @property
    def excess_nm(self) -> float:
        """Error beyond what is allowed, N·m."""
        return float(np.sqrt(max(self.rms_nm**2 - self.allowed_nm**2, 0.0)))

    @property
    def ratio(self) -> float:
        """Error over what is allowed."""
        return self.rms_nm / self.allowed_nm


def held_out_error(fitted: Fitted, compared_with: Fitted | None = None) -> HeldOutError | None:
    """The error of a model on the held-out intervals; None if there are too few, or if there is a tremor.

    Only rows count whose pulse widths, and those of the seconds before, are near fitted ones: elsewhere the recruitment
    curve is a guess. Efforts cannot be predicted, but they are rare: if one of the models has one, the median of the
    error counts instead of its root mean square.

    `compared_with`: a model that this one is compared with.
    """
    setup = fitted.problem.setup
    rows = np.isfinite(hold_out(fitted).error_nm)
    if rows.sum() < LEAST_HELD_OUT_ROWS or fitted.noise.band > 0.0:
        return None
    residual = fitted.residual_nm[rows]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fitted.hessian), 1e-300))
    scaled = fitted.hessian * scale[:, None] * scale[None, :] + 1e-12 * np.eye(scale.size)
    slopes = fitted.slopes[:, rows] * scale[:, None]
    band = np.sum(slopes * np.linalg.solve(scaled, slopes), axis=0)
    allowed = np.sqrt(fitted.noise.sd_nm**2 + float(np.mean(band)) + (FORM_ERROR * setup.scale_nm) ** 2)
    if not any(
        find_effect(effect).sporadic
        for effect, _ in [*fitted.effects, *(compared_with.effects if compared_with else [])]
    ):
        return HeldOutError(float(np.sqrt(np.mean(residual**2))), float(allowed))
    return HeldOutError(float(np.median(np.abs(residual)) / MEDIAN), float(allowed))


def vetoed(before: Fitted, after: Fitted) -> str | None:
    """Return the objection of held-out pulses to an effect, in words; None if there is none.

    They speak against it where the error rises, and by more than its standard error over pieces of the rows. They
    never speak for one.
    """
    old, new = hold_out(before), hold_out(after)
    if difference(old, new).errors > -thresholds.BETTER or not new.rms_nm > old.rms_nm:
        return None
    errors = f"{old.rms_nm:.3g}", f"{new.rms_nm:.3g}"
    return f"Held out, the error of a pulse interval's mean torque would rise from {errors[0]} to {errors[1]} N·m."


@dataclass(frozen=True)
class Remainder:
    """What the last model of a search leaves."""

    structure: bool  # whether the fitted or the held-out rows show that structure is left
    explained: float  # share of the explainable log-likelihood that the effects explain
    ratio: float  # log-likelihood by which the residuals at work and at rest still differ
    white_nm: float  # standard deviation that white noise of the samples alone gives an interval's mean
    held_out: HeldOutError | None  # None if held-out pulses cannot be judged
    contradiction: float | None
    """Mean square difference between its fits to parts of the record over the limit of a contradiction; None: too few
    parts."""
    open_gain: float  # log evidence of the best effect that was tried last and is not in the model
    notes: tuple[str, ...] = ()  # reasons, for people

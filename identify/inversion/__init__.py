"""Inversion: pulse widths whose torque follows a reference best, and where the reference cannot be reached."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import runs
from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.identify.inversion.demand import best_demand
from stimrig.identify.inversion.plant import NOTHING, Plant
from stimrig.identify.inversion.reference import Reference
from stimrig.identify.json_text import json_value
from stimrig.identify.model import Model
from stimrig.identify.problem.joint_surface import Surfaces
from stimrig.identify.problem.pulses import above_rest
from stimrig.identify.recruitment import THRESHOLD_SHARE
from stimrig.identify.results import Result
from stimrig.identify.summary import Sheet, quantity

__all__ = ["Inversion", "Reference", "invert"]

TURNS = 10
"""Corrections on the model's own prediction, at most: each is a trial that the model plays."""
STEP = 0.8
"""Share of the predicted error that a correction asks for."""
ENOUGH = 2e-3
"""Root mean square of the predicted error, as a share of the largest torque, below which no correction follows."""
GAIN = 0.97
"""A correction that leaves more than this share of the best error so far is the last one but one."""
TOLERANCE = 0.02
"""A torque that is missed by less of the largest one that the widest pulse gives counts as reached."""
JOINED = 3
"""Stretches of one reason with fewer pulses between them are one."""
LEAST_GAIN = 0.05
"""Where less than this share of the torque is left, stimulation is not the way to have more of it."""
REASONS = ("above-plateau", "below-zero", "rises-too-fast", "falls-too-fast", "under-threshold", "not-followed")
"""Too high for the largest width; the wrong sign, a muscle only pulls; faster than the muscle, or than the rise limit
allows; a pulse there gives too little or too much; the rest, for example an effect that cannot be undone."""


@dataclass(frozen=True)
class Stretch:
    """Where a reference cannot be reached; times from the first pulse."""

    begin_s: float
    end_s: float
    reason: str  # one of `REASONS`
    shortfall_nm: float  # the largest difference between reference and prediction in it, positive


@dataclass(frozen=True, repr=False, eq=False)
class Inversion(Result):
    """Pulse widths for a reference; arrays of shape (K,)."""

    reference: Reference  # what was asked for
    pulse_width_us: np.ndarray  # one for each pulse, shape (K,)
    predicted_nm: np.ndarray  # torque above rest that the model predicts for them, mean in each pulse's period
    unreachable: tuple[Stretch, ...]  # where it is not reached, in order of time
    fit_percent: float  # best fit where it can be reached; NaN if the reference does not change there
    whole_fit_percent: float  # of all of it
    tolerance_nm: float  # a smaller difference counts as reached

    def _sheet(self) -> Sheet:
        fit = f"fit {quantity(self.fit_percent, '%')} where it can be reached"
        missed = [
            (f"{part.begin_s:.2f} to {part.end_s:.2f} s", f"lacks {part.shortfall_nm:.2g} N·m: {part.reason}")
            for part in self.unreachable[:8]
        ]
        rows = [("widths", f"up to {quantity(self.pulse_width_us.max(), 'µs')}"), *missed]
        return Sheet(f"Pulse widths for a torque: {self.pulse_width_us.size} pulses, {fit}", tuple(rows))

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        reference = self.reference
        return json_value(
            {
                "pulse_rate_hz": reference.pulse_rate_hz,
                "duration_s": reference.torque_nm.size / reference.pulse_rate_hz,
                "reference_torque_nm": reference.torque_nm.round(6),
                **({} if reference.angle_rad is None else {"angle_rad": reference.angle_rad.round(6)}),
                "pulse_width_us": self.pulse_width_us,
                "predicted_torque_nm": self.predicted_nm.round(6),
                "unreachable": [vars(stretch) for stretch in self.unreachable],
                "fit_percent": self.fit_percent,
                "whole_fit_percent": self.whole_fit_percent,
                "tolerance_nm": self.tolerance_nm,
            }
        )


def invert(
    model: Model,
    reference: Reference,
    *,
    largest_us: float | None = None,
    rise_us: float | None = None,
    whole: bool = True,
    shortest_us: float = 0.0,
) -> Inversion:
    """The pulse widths whose predicted torque follows a reference best.

    The demand before f is found by regularised least squares through G (norm-optimal control, Amann, Owens and Rogers
    1996), with 0 and the largest demand as bounds; f is inverted; then the demand is corrected on what the model
    predicts, effects included, as between trials. Where the joint moves, the passive torque h is taken off what is
    wanted, and the rest divided by g (Fig. 2 of the paper, read backwards).

    Parameters
    ----------
    model : Model
        With second-order dynamics; with or without effects.
    reference : Reference
        Torque above rest.
    largest_us : float, optional
        Widest pulse, µs; never wider than the model is valid for.
    rise_us : float, optional
        Largest rise from pulse to pulse, µs. The rig's gate has such a limit.
    whole : bool
        Whole µs. What rounding takes is given back by the pulses after.
    shortest_us : float
        The stimulator's shortest pulse, µs: a narrower one is not sent, so it is 0 here.

    Raises
    ------
    BadModel
        The model has other dynamics, gives no torque, or holds for another pulse rate; it depends on the joint, and
        the reference has no angle.
    BadRequest
        A limit is not a positive number.
    """
    plant = Plant.of(model, reference, largest_us, rise_us, whole, shortest_us)
    wanted, angle, rate_hz = plant.sign * reference.torque_nm, reference.angle_rad, reference.pulse_rate_hz
    gain, passive_nm = np.ones(wanted.size), np.zeros(wanted.size)
    if (surfaces := Surfaces.of(model.effects)) is not None:
        passive_nm = plant.sign * above_rest(model, passive_nm, rate_hz, angle)
        motion = reference.motion
        assert motion is not None  # `above_rest` has refused
        gain = np.maximum(surfaces.g(motion.angle_rad, motion.velocity_rad_s), LEAST_GAIN)
    needed = (wanted - passive_nm) / gain  # what the muscle has to give at the model's own angle
    demand = widths = got = np.zeros(wanted.size)
    target, planned, least_rms_nm, idle = needed, demand, np.inf, 0
    for _ in range(TURNS):
        planned = best_demand(plant.a, plant.b, target, plant.largest_nm, plant.rises(planned))
        planned_us = plant.widths(planned)
        expected = plant.sign * above_rest(model, planned_us, rate_hz, angle)
        rms_nm = float(np.sqrt(np.mean((wanted - expected) ** 2)))
        idle = idle + 1 if rms_nm > GAIN * least_rms_nm else 0
        if rms_nm < least_rms_nm:
            demand, widths, got, least_rms_nm = planned, planned_us, expected, rms_nm
        if idle > 1 or rms_nm < ENOUGH * plant.largest_nm or (not model.effects and rise_us is None):
            break
        target = plant.linear(planned) + STEP * (wanted - expected) / gain
    tolerance_nm = TOLERANCE * plant.largest_nm
    missed = np.abs(wanted - got) > tolerance_nm
    reasons = _reasons(plant, needed, demand, missed, wanted > got, tolerance_nm)
    return Inversion(
        reference=reference,
        pulse_width_us=widths,
        predicted_nm=plant.sign * got,
        unreachable=_stretches(reasons, np.abs(wanted - got), rate_hz),
        fit_percent=best_fit_percent(wanted[~missed], got[~missed]),
        whole_fit_percent=best_fit_percent(wanted, got),
        tolerance_nm=tolerance_nm,
    )


# ---- where and why it is not reached ----


def _stretches(reasons: np.ndarray, error_nm: np.ndarray, pulse_rate_hz: float) -> tuple[Stretch, ...]:
    stretches = []
    for index, reason in enumerate(REASONS):
        rows = reasons == index
        for gap in runs(~rows):
            if gap.start > 0 and gap.stop < rows.size and gap.stop - gap.start < JOINED:
                rows[gap] = True
        for run in runs(rows):
            begin_s, end_s = (round(float(place / pulse_rate_hz), 6) for place in (run.start, run.stop))
            stretches.append(Stretch(begin_s, end_s, reason, round(float(np.max(error_nm[run])), 6)))
    return tuple(sorted(stretches, key=lambda stretch: stretch.begin_s))


def _reasons(
    plant: Plant, wanted: np.ndarray, demand: np.ndarray, missed: np.ndarray, short: np.ndarray, tolerance_nm: float
) -> np.ndarray:
    """Index into `REASONS` for each pulse, -1 where it is reached; shape (K,)."""
    lasting = np.zeros(wanted.size, bool)
    for run in runs(demand >= (1.0 - NOTHING) * plant.largest_nm):
        lasting[run.start + plant.settled : run.stop] = True  # the muscle gives all that it has by then
    high = short & (lasting | (wanted > plant.largest_nm + tolerance_nm))
    reasons = np.full(wanted.size, -1)
    for k in np.flatnonzero(missed):
        if wanted[k] < -tolerance_nm:
            reason = "below-zero"
        elif high[k]:
            reason = "above-plateau"
        elif change := _change(wanted, int(k), plant.settled, tolerance_nm):
            reason = "rises-too-fast" if change > 0.0 else "falls-too-fast"
        else:
            reason = "under-threshold" if 0.0 < wanted[k] < THRESHOLD_SHARE * plant.largest_nm else "not-followed"
        reasons[k] = REASONS.index(reason)
    return reasons


def _change(wanted: np.ndarray, k: int, near: int, tolerance_nm: float) -> float:
    """The nearest change of the reference that in a settling time would be more than the tolerance; 0 if there is none.

    One that is too fast is missed on both sides: the best demand begins before it.
    """
    first = max(k - near, 0)
    part = np.r_[wanted[first - 1] if first else 0.0, wanted[first : k + near + 1]]
    if np.ptp(part) <= tolerance_nm:
        return 0.0
    change = np.diff(part)
    steep = np.flatnonzero(np.abs(change) >= min(tolerance_nm / near, np.max(np.abs(change))))
    return float(change[steep[np.argmin(np.abs(steep + first - k))]])

"""What the widths give, and where and why that is not what was asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import runs
from stimrig.identify.inversion.plant import NOTHING, Plant
from stimrig.identify.inversion.reference import Reference
from stimrig.identify.json_text import json_value

TOLERANCE = 0.02
"""A torque that is missed by less of the largest torque counts as reached."""
JOINED = 3
"""Stretches of one reason with fewer pulses between them are one."""
REASONS = (
    "above-plateau",
    "below-zero",
    "rises-too-fast",
    "falls-too-fast",
    "under-threshold",
    "not-followed",
)
"""Too high for the largest width; the wrong sign, a muscle only pulls; faster than the muscle, or than the rise limit
allows; a pulse there gives too little or too much; the rest, for example an effect that cannot be undone."""


@dataclass(frozen=True)
class Stretch:
    """Where a reference cannot be reached.

    Parameters
    ----------
    begin_s, end_s : float
        Time from the first pulse.
    reason : str
        One of `REASONS`.
    shortfall_nm : float
        The largest difference between reference and prediction in it, N·m, positive.
    """

    begin_s: float
    end_s: float
    reason: str
    shortfall_nm: float


@dataclass(frozen=True)
class Inversion:
    """Pulse widths for a reference.

    Parameters
    ----------
    reference : Reference
        What was asked for.
    pulse_width_us : ndarray, shape (K,)
        µs.
    predicted_nm : ndarray, shape (K,)
        Torque above rest that the model predicts for them, mean in each pulse's period, N·m.
    unreachable : tuple of Stretch
        Where it is not reached, in order of time.
    fit_percent : float or None
        Best fit % where it can be reached; None if the reference does not change there.
    whole_fit_percent : float or None
        Of all of it.
    tolerance_nm : float
        A smaller difference counts as reached, N·m.
    """

    reference: Reference
    pulse_width_us: np.ndarray
    predicted_nm: np.ndarray
    unreachable: tuple[Stretch, ...]
    fit_percent: float | None
    whole_fit_percent: float | None
    tolerance_nm: float

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
                "unreachable": [
                    {name: value if name == "reason" else round(value, 6) for name, value in vars(one).items()}
                    for one in self.unreachable
                ],
                "fit_percent": self.fit_percent,
                "whole_fit_percent": self.whole_fit_percent,
                "tolerance_nm": self.tolerance_nm,
            }
        )


def judged(
    plant: Plant,
    reference: Reference,
    needed_nm: np.ndarray,
    demand_nm: np.ndarray,
    widths_us: np.ndarray,
    got_nm: np.ndarray,
) -> Inversion:
    """The result, with torque `got_nm` positive in the direction of pull.

    `needed_nm` is what the muscle itself has to give: the reference, but for what the joint adds and takes.
    """
    wanted = plant.sign * reference.torque_nm
    tolerance_nm = TOLERANCE * plant.largest_nm
    missed = np.abs(wanted - got_nm) > tolerance_nm
    reasons = _reasons(plant, needed_nm, demand_nm, missed, wanted > got_nm, tolerance_nm)
    step_s = 1.0 / reference.pulse_rate_hz
    stretches = [
        Stretch(
            float(run.start * step_s),
            float(run.stop * step_s),
            reason,
            float(np.max(np.abs(wanted - got_nm)[run])),
        )
        for index, reason in enumerate(REASONS)
        for run in runs(_joined(reasons == index))
    ]
    stretches.sort(key=lambda one: one.begin_s)
    return Inversion(
        reference=reference,
        pulse_width_us=widths_us,
        predicted_nm=plant.sign * got_nm,
        unreachable=tuple(stretches),
        fit_percent=_best_fit(wanted[~missed], got_nm[~missed]),
        whole_fit_percent=_best_fit(wanted, got_nm),
        tolerance_nm=tolerance_nm,
    )


def _best_fit(wanted: np.ndarray, got: np.ndarray) -> float | None:
    """100 (1 - ||y - ŷ|| / ||y - mean y||), as in the paper."""
    spread = float(np.linalg.norm(wanted - wanted.mean())) if wanted.size else 0.0
    return None if spread < 1e-9 else 100.0 * (1.0 - float(np.linalg.norm(wanted - got)) / spread)


def _joined(rows: np.ndarray) -> np.ndarray:
    """Short gaps filled."""
    filled = rows.copy()
    for gap in runs(~rows):
        if gap.start > 0 and gap.stop < rows.size and gap.stop - gap.start < JOINED:
            filled[gap] = True
    return filled


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
            reason = "under-threshold" if 0.0 < wanted[k] < plant.threshold_nm else "not-followed"
        reasons[k] = REASONS.index(reason)
    return reasons


def _change(wanted: np.ndarray, k: int, near: int, tolerance_nm: float) -> float:
    """The steepest change of the reference about a pulse, the nearest one of such; 0 if it hardly changes.

    One that is too fast is missed on both sides: the best demand begins before it.
    """
    first = max(k - near, 0)
    part = np.r_[wanted[first - 1] if first else 0.0, wanted[first : k + near + 1]]
    if np.ptp(part) <= tolerance_nm:
        return 0.0
    change = np.diff(part)
    steep = np.flatnonzero(np.abs(change) >= 0.5 * np.max(np.abs(change)))
    return float(change[steep[np.argmin(np.abs(steep + first - k))]])

"""The yardstick of repetition: what a record says cannot be better, since the same input did not give the same torque.

Where the same pulse widths came several times (`dynamics/repeats.py`) the torque's variance between the repeats is what
no model can take away whose output follows from the pulse widths of the last seconds. It holds noise, a wandering zero
and the muscle's own whims; and slow changes such as fatigue, of which a model with an effect may explain a part. Where
nothing repeats, the scatter of the torque at rest stands for it, whatever the model: at least so much no model can
foresee. What varies only at work, or from rest to rest, is not in it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.estimation.rests import relaxed, scatter_at_rest
from stimrig.identify.records.record import FORGOTTEN_S
from stimrig.identify.yardstick import floor_nm

EXACT, ESTIMATE = "exact repeats", "estimate"
LEAST_S = 1.0
"""Shortest time with repeated input, or at rest, that is evaluated."""
DECAYS_S = (0.2, 0.5, 1.2)
"""Time constants of decays whose sum follows what a slow muscle still relaxes in a rest."""
LEAST_SHARE = 0.75
"""If less than this share of the variance repeats, what differs may hide any error: no share is reported."""
UNKNOWN: dict[str, Any] = dict.fromkeys(
    ("found_by", "repeats", "seconds", "rms_nm", "model_rms_nm", "explained_percent", "held_out_rms_nm",
     "held_out_model_rms_nm")
)  # fmt: skip


def repetition(grid: Grid, error_nm: np.ndarray, rows: np.ndarray) -> dict[str, Any]:
    """Measure what repeats in a record, and how much of that a model explains.

    All values are of means over pulse intervals. With torque y of an interval of a group of n with the same input, the
    between-repeat variance is s² = Σ (y - mean of its group)² / Σ (n - 1), the sums over all intervals and groups. A
    plain repetition predicts an interval of `validate` as the mean of the others of its group: from n - 1 of them it
    errs by √(1 + 1/(n-1)) s, if all vary alike. `explained_percent` is 100 (1 - (e² - s²) / v), between 0 and 100: e is
    the model's error, v the variance that repeats: that of the groups' means, less s²/n for their own error. Of
    `validate` alone if enough of it repeats. In an estimate s² is the torque's variance about straight lines and decays
    in the rests, and v is the variance of the torque less s².

    `error_nm`, shape (K,): measured minus predicted; of fitted intervals as predicted when they were left out of the
    fit, if known. `rows`, bool, shape (K,): intervals that were fitted.

    Returns `found_by` ("exact repeats", "estimate" or None), `repeats` (how often the same input came, in the mean),
    `seconds` (time that counts), `rms_nm` (between repeats), `model_rms_nm` and `explained_percent` there,
    `held_out_rms_nm` (a plain repetition on `validate`) and `held_out_model_rms_nm` (the model on the same
    intervals). None where it is not known.
    """
    usable = grid.comparable & (rows | grid.held_out)
    min_rows = LEAST_S / grid.step_s
    group, size = _groups(np.where(usable, grid.repeats, -1))
    at = np.flatnonzero(group >= 0)
    if at.size - size.size >= min_rows:
        torque = grid.torque_nm[at]
        mean = np.bincount(group[at], torque) / size
        variance = float(np.sum((torque - mean[group[at]]) ** 2)) / (at.size - size.size)
        result = UNKNOWN | {"found_by": EXACT, "repeats": at.size / size.size}
        at = _unseen(grid, at, min_rows)
        repeating = float(np.var(mean[group[at]]) - variance * np.mean(1.0 / size[group[at]]))
        result |= _plain_repetition(grid, error_nm, group, min_rows)
    else:
        lowest_us = float(grid.pulse_width_us.min())  # taken as rest where the width never becomes 0
        rests = usable & ~grid.held_out & relaxed(grid, FORGOTTEN_S, lowest_us)
        at = _unseen(grid, np.flatnonzero(usable & ~rests), min_rows)
        variance, free = scatter_at_rest(grid, rests, grid.torque_nm, DECAYS_S)
        if free < min_rows or not at.size:
            return dict(UNKNOWN)
        result = UNKNOWN | {"found_by": ESTIMATE}
        repeating = float(np.var(grid.torque_nm[at])) - variance
    model = float(np.mean(error_nm[at] ** 2))
    result |= {"rms_nm": variance**0.5, "model_rms_nm": model**0.5}
    if floor_nm(result) is not None and repeating > LEAST_SHARE * float(np.var(grid.torque_nm[at])):
        share = 1.0 - (model - variance) / repeating
        result["explained_percent"] = 100.0 * float(np.clip(share, 0.0, 1.0))
    return result | {"seconds": at.size * grid.step_s}


def _groups(label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The groups of at least two intervals, numbered from 0 (shape (K,), else -1), and their sizes."""
    labels, place, size = np.unique(label, return_inverse=True, return_counts=True)
    repeated = (labels >= 0) & (size > 1)
    return np.where(repeated, np.cumsum(repeated) - 1, -1)[place], size[repeated]


def _unseen(grid: Grid, at: np.ndarray, min_rows: float) -> np.ndarray:
    """Those of some intervals that are in `validate`, if there are enough; else all."""
    unseen = at[grid.held_out[at]]
    return unseen if unseen.size >= min_rows else at


def _plain_repetition(grid: Grid, error_nm: np.ndarray, group: np.ndarray, min_rows: float) -> dict[str, float]:
    """The error on `validate` of the mean of the repeats elsewhere, and the model's on the same intervals."""
    fitted, unseen = (np.flatnonzero((group >= 0) & (grid.held_out == is_held_out)) for is_held_out in (False, True))
    count = np.bincount(group[fitted], minlength=int(group.max()) + 1)
    mean = np.bincount(group[fitted], grid.torque_nm[fitted], count.size) / np.maximum(count, 1)
    unseen = unseen[count[group[unseen]] > 0]
    if unseen.size < min_rows:
        return {}
    plain = grid.torque_nm[unseen] - mean[group[unseen]]
    return {
        "held_out_rms_nm": float(np.sqrt(np.mean(plain**2))),
        "held_out_model_rms_nm": float(np.sqrt(np.mean(error_nm[unseen] ** 2))),
    }

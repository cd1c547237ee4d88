"""The approved model as it stands now: its curve with gain and shift, its dynamics with the time scale."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from identify.dynamics.linear import SecondOrder
from identify.errors import BadModel
from identify.model import Model
from identify.recruitment.curve import Curve
from identify.recruitment.spline import SplineBasis
from identify.tracking.carried import with_states
from identify.tracking.state import Values

EVEN = 31
"""Knots of the moved curve, evenly spaced, beside those of the approved curve."""
CLOSEST_US = 0.5
"""Knots are no closer than this."""
PER_KNOT = 6


def moved_curve(curve: Curve, values: Values) -> Curve:
    """gain · f(u - shift), as a spline if it is shifted; beyond the curve's end it goes on level.

    Parameters
    ----------
    curve : Curve
        Of the approved model.
    values : Values
        Gain and shift.
    """
    if values.threshold_shift_us == 0.0:
        return replace(curve, coefficients_nm=values.gain * curve.coefficients_nm)
    largest = curve.basis.largest_us
    own = np.asarray(getattr(curve.basis, "knots_us", np.zeros(0))) + values.threshold_shift_us
    basis = SplineBasis(_apart(np.r_[own, np.linspace(0.0, largest, EVEN)], largest))
    # Between every two knots the same number of places, so that a steep rise counts as much as a long plateau.
    share = np.arange(PER_KNOT) / PER_KNOT
    u = np.r_[(basis.knots_us[:-1, None] + share * np.diff(basis.knots_us)[:, None]).ravel(), largest]
    wanted = values.gain * curve(np.clip(u - values.threshold_shift_us, 0.0, largest))
    return Curve(basis, np.linalg.lstsq(basis.design(u), wanted, rcond=None)[0])


def _apart(knots_us: np.ndarray, largest_us: float) -> np.ndarray:
    """The knots within 0 and the largest width, both included, without those too close to one before them."""
    inner = np.sort(knots_us[(knots_us > CLOSEST_US) & (knots_us < largest_us - CLOSEST_US)])
    kept = [0.0]
    for knot in inner.tolist():
        if knot - kept[-1] >= CLOSEST_US:
            kept.append(knot)
    return np.array([*kept, largest_us])


def largest_change(model: Model, curve_nm: np.ndarray) -> float:
    """How far `curve_nm` moves the curve anywhere, as a share of its largest torque."""
    change = replace(model.recruitment, coefficients_nm=curve_nm).table()[1]
    return float(np.max(np.abs(change)) / max(np.ptp(model.recruitment.table()[1]), 1e-9))


def moved_model(
    model: Model, values: Values, curve_nm: np.ndarray | float = 0.0, effects: Mapping[str, float] | None = None
) -> Model:
    """The model with the levels of `values`, with `curve_nm` added to the coefficients of its curve, and its effects
    where `effects` says that they begin.

    Raises
    ------
    BadModel
        The model's dynamics are not of second order.
    """
    if not isinstance(model.linear, SecondOrder):
        raise BadModel("only second-order dynamics are tracked", fix="Fit with maximum-likelihood.")
    linear = replace(model.linear, time_constant_s=model.linear.time_constant_s * values.time_scale)
    sign = float(model.effects[0].get("settings", {}).get("sign", 1.0)) if model.effects else 1.0
    own = replace(model.recruitment, coefficients_nm=model.recruitment.coefficients_nm + sign * curve_nm)
    # What was known of the approved model's own parameters holds for none of the moved ones.
    begun = with_states(model, effects or {})
    return begun.with_(recruitment=moved_curve(own, values), linear=linear, covariance=None, bands={})

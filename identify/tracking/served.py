"""The approved model as it stands now: its curve with gain and shift, its dynamics with the time scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from identify.dynamics.linear import SecondOrder
from identify.errors import BadModel
from identify.model import Model
from identify.recruitment.curve import Curve
from identify.recruitment.spline import SplineBasis
from identify.tracking.state import Values

STEPS = 60
"""Knots of the moved curve, evenly spaced, beside those of the approved curve."""


def moved_curve(curve: Curve, values: Values) -> Curve:
    """gain · f(u - shift), as a spline; beyond the approved curve's end it goes on level.

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
    basis = SplineBasis(np.linspace(0.0, largest, STEPS + 1))
    u = np.linspace(0.0, largest, 8 * STEPS + 1)
    wanted = values.gain * curve(np.clip(u - values.threshold_shift_us, 0.0, largest))
    design = basis.design(u)
    return Curve(basis, np.linalg.lstsq(design, wanted, rcond=None)[0])


def moved_model(model: Model, values: Values) -> Model:
    """The model with the levels of `values`.

    Raises
    ------
    BadModel
        The model's dynamics are not of second order.
    """
    if not isinstance(model.linear, SecondOrder):
        raise BadModel("only second-order dynamics are tracked", fix="Fit with maximum-likelihood.")
    linear = replace(model.linear, time_constant_s=model.linear.time_constant_s * values.time_scale)
    return model.with_(recruitment=moved_curve(model.recruitment, values), linear=linear)

"""The approved model as it stands now: its effects' slow states, its curve with gain and shift, its time scale.

A slow state x (fatigue, potentiation) goes from 0 (rested) to 1. The pulses fill it by the effect's own law, with the
gain and the threshold as they are tracked; rests empty it. What the effect does not explain of a trial, the tracked
gain takes up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.effects import registry
from stimrig.identify.effects.base import Form, Scene
from stimrig.identify.errors import BadModel
from stimrig.identify.model import Model
from stimrig.identify.model_schema import parameter_value
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment import Curve
from stimrig.identify.recruitment.bases import SplineBasis
from stimrig.identify.tracking.state import State, Values
from stimrig.identify.tracking.trial import placed

CLOCK_S = 0.1
"""By so much a record may seem to begin before the end of the one before it: clocks are set."""
EVEN = 31
"""Knots of the moved curve, evenly spaced, beside those of the approved curve."""
CLOSEST_US = 0.5
"""Knots are no closer than this."""
PER_KNOT = 6


def slow_forms(model: Model) -> dict[str, tuple[Form, dict[str, Any]]]:
    """By effect id, the form and the parameters of each of the model's effects that has a slow state."""
    found = {}
    for entry in model.effects:
        effect = registry().get(entry["id"])
        forms = () if effect is None else effect.forms
        form = next((form for form in forms if entry.get("form", "") in ("", form.name)), None)
        if form is not None and form.state is not None:
            values = {name: np.full((1, 1), parameter_value(value)) for name, value in entry["parameters"].items()}
            found[entry["id"]] = form, values
    return found


def with_states(model: Model, states: Mapping[str, float]) -> Model:
    """The model with its effects' states at the begin of what is predicted."""
    if not states:
        return model
    entries = (entry | {"state": states[entry["id"]]} if entry["id"] in states else entry for entry in model.effects)
    return model.with_(effects=tuple(entries))


def rest_before(state: State, record: Record, rest_s: float | None = None) -> float | None:
    """Rest between what was seen last and a record, s: as given, else by their clocks; None: not known."""
    begun_s = record.parts[0].begun_s
    if rest_s is None and begun_s is not None and state.ended_s is not None:
        rest_s = begun_s + record.parts[0].own_s - state.ended_s
    return max(rest_s, 0.0) if rest_s is not None and rest_s >= -CLOCK_S else None


def rested(model: Model, states: Mapping[str, float], rest_s: float | None) -> dict[str, float]:
    """States after a rest; a rest of unknown length is taken for one after which all have recovered."""
    found = {}
    for effect, (form, values) in slow_forms(model).items() if states else ():
        if rest_s is None:
            found[effect] = 0.0
            continue
        assert form.state is not None
        scene = Scene(np.zeros(1), np.zeros(1), 0.0, 1.0, 1.0, pauses_s=np.array([rest_s]), states=states)
        found[effect] = float(form.state(np.zeros((1, 1)), values, scene)[0])
    return found


def passed(model: Model, state: State, record: Record, rest_s: float | None = None) -> State:
    """The state with what a record's pulses and the rest before it have done to the effects; levels and trends stay.

    For a record that teaches nothing else: the test before the session, or a trial that cannot be followed.

    Raises
    ------
    BadModel, BadRecord
        As `stimrig.identify.tracking.trial.look`, of any pulse rate.
    """
    if not slow_forms(model):
        return state
    begun = rested(model, state.effects, rest_before(state, record, rest_s))
    problem, theta = placed(with_states(model, begun), state.mean[state.seen], make_grid(record))
    return replace(state, effects=problem.states(theta), ended_s=_end_s(record))


def _end_s(record: Record) -> float | None:
    """When the last sample's interval ended, as Unix time; None: not known."""
    last = record.parts[-1]
    if last.begun_s is None:
        return None
    return (
        last.begun_s + last.own_s + float(record.time_s[-1] - record.time_s[last.first]) + 1.0 / record.sample_rate_hz
    )


def moved_curve(curve: Curve, values: Values) -> Curve:
    """gain · f(u - shift), as a spline if it is shifted; beyond the curve's end it goes on level."""
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

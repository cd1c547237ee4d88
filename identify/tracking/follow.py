"""Tracking over trials: prediction, fit of a trial, updated estimate, and the outcome for people.

The approved model stands as it is now: its effects' slow states, its curve with gain and shift, its time scale. A slow
state x (fatigue, potentiation) goes from 0 (rested) to 1. The pulses fill it by the effect's own law, with the gain and
the threshold as they are tracked; rests empty it. What the effect does not explain of a trial, the tracked gain takes
up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.effects import known_form
from stimrig.identify.effects.base import Form, Scene
from stimrig.identify.errors import BadModel, BadRequest
from stimrig.identify.json_text import json_value
from stimrig.identify.model import Model
from stimrig.identify.model_schema import parameter_value
from stimrig.identify.problem.predict import refuse_rate
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment import Curve
from stimrig.identify.recruitment.bases import SplineBasis
from stimrig.identify.results import Result
from stimrig.identify.summary import Sheet, quantity
from stimrig.identify.tracking.state import CURVE, LEVELS, QUANTITIES, USUAL, Rates, State
from stimrig.identify.tracking.trial import TrialFit, curve_covariance, fit_trial, placed

UNEXPLAINED = 4.0
"""An error so many times what the approved model left is not one of gain, threshold or speed."""
GONE = 0.25
"""Where less of the expected torque came, something came loose: no muscle changes so much from trial to trial."""
ENOUGH = 0.05
"""Least range of the expected torque, as a share of the model's largest, from which that can be decided."""
LITTLE = np.array([0.05, 5.0, 0.08])
"""A trial that determines no level to within such a standard deviation teaches little."""

USUAL_REST_S = 15.0
"""Rest after the first trial, as it is expected: in the one before it the model was approved."""
CLOCK_S = 0.1
"""By so much a record may seem to begin before the end of the one before it: clocks are set."""
EVEN = 31
"""Knots of the moved curve, evenly spaced, beside those of the approved curve."""
CLOSEST_US = 0.5
"""Knots are no closer than this."""
PER_KNOT = 6
MOST_SHOWN = 9
"""Trials that a summary shows."""


class Outcome(StrEnum):
    """Outcome of a trial."""

    FOLLOWED = "followed"
    LITTLE = "little"
    """It determines no level well: too short, too weak, or too uneven."""
    ODD = "odd"
    """It is far from what was expected, or something else happened in it. It moves little or nothing."""
    NO_TORQUE = "no-torque"
    """The pulses gave next to no torque: an electrode or a cable is loose. It moves nothing."""
    CONTRADICTS = "contradicts"
    """Gain, threshold and speed do not explain two trials running: the structure is no longer the model's."""


@dataclass(frozen=True)
class Step:
    """One trial followed.

    `coming_effects` are expected after a rest as long as the one before this trial, but at most `USUAL_REST_S` if that
    was the first.
    """

    outcome: Outcome  # what the trial shows
    fit: TrialFit  # of this trial alone
    before: State  # prediction before it
    after: State  # estimate after it
    coming: State  # prediction for the next trial, for the controller
    coming_effects: Mapping[str, float]  # their slow states when the next trial begins
    distance: float | None  # squared, of what was seen from what was expected, in sd; None if it moved nothing

    @property
    def disturbed_s(self) -> list[list[float]]:
        """Stretches from which nothing should be learnt, s since the record's begin: all of a trial that is odd."""
        if self.outcome in (Outcome.ODD, Outcome.NO_TORQUE, Outcome.CONTRADICTS):
            return [[0.0, self.fit.duration_s]]
        return [list(stretch) for stretch in self.fit.disturbed]

    def to_dict(self) -> dict[str, Any]:
        """As JSON: the levels of this trial and of the next with their bands, and what people may ask."""
        return {
            "outcome": str(self.outcome),
            "trial": self.after.trials,
            "now": self.after.bands(),
            "coming": self.coming.bands(),
            "error_nm": self.fit.error_nm,
            "expected_error_nm": self.fit.expected_nm,
            "error_before_nm": self.fit.before_nm,
            "torque_nm": self.fit.torque_nm,
            "disturbed_s": self.disturbed_s,
            "distance": self.distance,
            "effects": {
                effect: {"now": now, "coming": self.coming_effects[effect]}
                for effect, now in self.after.effects.items()
            },
            "state": self.coming.to_dict(),
        }


def begin(model: Model, rates: Rates = USUAL) -> State:
    """Predict the first trial after an approval; `rates`: how fast muscles change."""
    return State.start(curve_covariance(model), rates)


def follow(
    model: Model, state: State | None, record: Record, rates: Rates = USUAL, rest_s: float | None = None
) -> Step:
    """Learn from one trial.

    Parameters
    ----------
    model : Model
        The approved one, with second-order dynamics. It is not changed.
    state : State or None
        What was expected of this trial: `coming` of the trial before; None for the first.
    record : Record
        The trial, with its rest before and after.
    rates : Rates
        How fast this person changes.
    rest_s : float, optional
        Rest between the end of what was seen last and this record's begin, s. None: by their clocks, `Part.begun_s`.
        If it is not known, or no rest (negative, not a number), the muscle is taken to have recovered.

    Raises
    ------
    BadModel
        The model's dynamics are not of second order, the record's pulse rate is another one, or see
        `stimrig.identify.problem.predict.problem_of`.
    BadRecord
        The record is too short, or sampled more slowly than the pulses.
    """
    refuse_rate(model, record)
    before = begin(model, rates) if state is None else state
    rest_s = _rest_before(before, record, rest_s)
    begun = rested(model, before.effects, rest_s)
    fit = fit_trial(set_states(model, begun), before, record)
    if fit.slope < GONE and fit.wanted_nm > ENOUGH * float(np.ptp(model.recruitment.table()[1])):
        after, distance, outcome = replace(before, trials=before.trials + 1), None, Outcome.NO_TORQUE
    elif not (fit.misfit <= UNEXPLAINED):
        after, distance = replace(before, trials=before.trials + 1, unexplained=before.unexplained + 1), None
        outcome = Outcome.CONTRADICTS if after.unexplained > 1 else Outcome.ODD
    else:
        after, distance = before.updated(fit.vector, fit.information)
        information = fit.information[:LEVELS, :LEVELS] + np.diag(1e-3 / LITTLE**2)
        little = np.all(np.sqrt(np.diag(np.linalg.inv(information))) > LITTLE)
        outcome = Outcome.ODD if after.odd is not None else Outcome.LITTLE if little else Outcome.FOLLOWED
    after = passed(model, replace(after, effects=begun), record, 0.0)
    next_s = rest_s if before.trials or rest_s is None else min(rest_s, USUAL_REST_S)
    return Step(outcome, fit, before, after, after.predicted(rates), rested(model, after.effects, next_s), distance)


def model_for_next(model: Model, step: Step, bounds: Mapping[str, Sequence[float]] | None = None) -> Model:
    """The approved model as it is expected to be in the next trial, as far as it may move.

    Parameters
    ----------
    model : Model
        The approved one.
    step : Step
        The last trial.
    bounds : mapping of str to (float, float), optional
        Least and most of each quantity that may move; the others stay as approved. All three are followed
        nevertheless: a fixed one would be taken for a change of the others. By default all move freely.
        The caller checks that the expected values themselves are inside.
    """
    levels, curve_nm = step.coming.mean[:LEVELS], step.coming.mean[CURVE:]
    if bounds is not None:
        levels = np.where([name in bounds for name in QUANTITIES], levels, 0.0)
        low, high = bounds.get("gain", (1.0, 1.0))
        # The torque of every pulse stays within what the gain may be; if it does not, the curve keeps its shape.
        change = replace(model.recruitment, coefficients_nm=curve_nm).table()[1]
        share = float(np.max(np.abs(change)) / max(np.ptp(model.recruitment.table()[1]), 1e-9))
        gain = float(np.exp(levels[0]))
        curve_nm = curve_nm if low <= gain * (1.0 - share) and gain * (1.0 + share) <= high else 0.0 * curve_nm
    return moved_model(model, levels, curve_nm, step.coming_effects)


@dataclass(frozen=True, repr=False, eq=False)
class Tracked(Result):
    """A model followed over trials: gain, threshold and time scale after each."""

    approved: Model  # the model that was followed; it stays as it is
    steps: tuple[Step, ...]  # one for each trial

    @property
    def model(self) -> Model:
        """The model as it is expected to be in the next trial."""
        return model_for_next(self.approved, self.steps[-1])

    def to_dict(self) -> dict[str, Any]:
        """For each trial its outcome, and the levels `now` and `coming` with their bands (95 %)."""
        return {"model_id": self.approved.model_id, "trials": [json_value(step.to_dict()) for step in self.steps]}

    def _sheet(self) -> Sheet:
        rows = []
        for number, step in enumerate(self.steps, 1):
            now = step.after.values
            words = f"gain {quantity(now['gain'], '')}, threshold {now['threshold_shift_us']:+.3g} µs, time scale "
            words += f"{quantity(now['time_scale'], '')}, error {quantity(step.fit.error_nm, 'N·m')}"
            rows.append((f"trial {number}", f"{step.outcome}: {words}"))
        hidden = [("", f"and {len(rows) - MOST_SHOWN} trials before")] if len(rows) > MOST_SHOWN else []
        return Sheet(f"Model {self.approved.model_id[:8]} over {len(rows)} trials", (*hidden, *rows[-MOST_SHOWN:]))


def track(model: Model, trials: Sequence[Record]) -> Tracked:
    """Follow a model over trials, in their order: how the muscle's gain, threshold and time scale have moved.

    Parameters
    ----------
    model : Model
        With second-order dynamics.
    trials : sequence of Record
        At least one, each with its rest before and after.

    Raises
    ------
    BadModel, BadRecord
        As `stimrig.identify.tracking.follow`.
    BadRequest
        No trial is given.
    """
    steps: list[Step] = []
    for trial in trials:
        steps.append(follow(model, steps[-1].coming if steps else None, trial))
    if not steps:
        raise BadRequest("no trial", place="trials", fix="Give at least one record.")
    return Tracked(model, tuple(steps))


# ---- the approved model as it stands now ----


def slow_forms(model: Model) -> dict[str, tuple[Form, dict[str, Any]]]:
    """By effect id, the form and the parameters of each of the model's effects that has a slow state."""
    forms = {}
    for entry in model.effects:
        known = known_form(entry)
        if known and known[1].state is not None:
            values = {name: np.full((1, 1), parameter_value(value)) for name, value in entry["parameters"].items()}
            forms[entry["id"]] = known[1], values
    return forms


def set_states(model: Model, states: Mapping[str, float]) -> Model:
    """The model with its effects' states at the begin of what is predicted."""
    entries = (entry | {"state": states[entry["id"]]} if entry["id"] in states else entry for entry in model.effects)
    return model.with_(effects=tuple(entries))


def rested(model: Model, states: Mapping[str, float], rest_s: float | None) -> dict[str, float]:
    """States after a rest; a rest of unknown length is taken for one after which all have recovered."""
    states_after = {}
    for effect, (form, values) in slow_forms(model).items() if states else ():
        states_after[effect] = 0.0
        if rest_s is not None and form.state is not None:
            scene = Scene(np.zeros(1), np.zeros(1), 0.0, 1.0, 1.0, pauses_s=np.array([rest_s]), states=states)
            states_after[effect] = float(form.state(np.zeros((1, 1)), values, scene)[0])
    return states_after


def passed(model: Model, state: State, record: Record, rest_s: float | None = None) -> State:
    """The state with what a record's pulses and the rest before it have done to the effects; levels and trends stay.

    For a record that teaches nothing else: the test before the session, or a trial that cannot be followed. `rest_s`:
    rest before the record, s; None: by the clocks. Raises BadModel, BadRecord: as `follow`, but for any pulse rate.
    """
    if not slow_forms(model):
        return state
    begun = rested(model, state.effects, _rest_before(state, record, rest_s))
    problem, theta = placed(set_states(model, begun), state.mean[state.observed], make_grid(record))
    last, ended_s = record.parts[-1], None
    if last.begun_s is not None:
        part_s = float(record.time_s[-1] - record.time_s[last.first]) + 1.0 / record.sample_rate_hz
        ended_s = last.begun_s + last.own_s + part_s
    return replace(state, effects=problem.states(theta), ended_s=ended_s)


def _rest_before(state: State, record: Record, rest_s: float | None) -> float | None:
    """Rest between what was seen last and a record, s: as given, else by their clocks; None: not known."""
    begun_s = record.parts[0].begun_s
    if rest_s is None and begun_s is not None and state.ended_s is not None:
        rest_s = begun_s + record.parts[0].own_s - state.ended_s
    return max(rest_s, 0.0) if rest_s is not None and rest_s >= -CLOCK_S else None


def moved_model(
    model: Model, levels: np.ndarray, curve_nm: np.ndarray | float = 0.0, effects: Mapping[str, float] | None = None
) -> Model:
    """The model at such `levels` (log gain, threshold shift in µs, log time scale), with `curve_nm` added to the
    coefficients of its curve, and its effects where `effects` says by id that they begin.

    Raises BadModel: the model's dynamics are not of second order.
    """
    if not isinstance(model.linear, SecondOrder):
        raise BadModel("only second-order dynamics are tracked", fix="Fit with maximum-likelihood.")
    gain, shift_us, time_scale = float(np.exp(levels[0])), float(levels[1]), float(np.exp(levels[2]))
    linear = replace(model.linear, time_constant_s=model.linear.time_constant_s * time_scale)
    sign = float(model.effects[0]["settings"]["sign"]) if model.effects else 1.0
    coefficients_nm = gain * (model.recruitment.coefficients_nm + sign * curve_nm)
    curve = _shifted(replace(model.recruitment, coefficients_nm=coefficients_nm), shift_us)
    # Covariance and bands of the approved parameters do not hold for the moved ones.
    return set_states(model, effects or {}).with_(recruitment=curve, linear=linear, covariance=None, bands={})


def _shifted(curve: Curve, shift_us: float) -> Curve:
    """f(u - shift), as a spline if it is shifted; beyond the curve's end it goes on level."""
    if shift_us == 0.0:
        return curve
    largest = curve.basis.largest_us
    knots_us = np.r_[np.asarray(getattr(curve.basis, "knots_us", ())) + shift_us, np.linspace(0.0, largest, EVEN)]
    inner = np.unique(np.round(knots_us / CLOSEST_US)) * CLOSEST_US
    inner = inner[(inner >= CLOSEST_US) & (inner <= largest - CLOSEST_US)]
    basis = SplineBasis(np.r_[0.0, inner, largest])
    # Between every two knots the same number of places, so that a steep rise counts as much as a long plateau.
    share = np.arange(PER_KNOT) / PER_KNOT
    u = np.r_[(basis.knots_us[:-1, None] + share * np.diff(basis.knots_us)[:, None]).ravel(), largest]
    wanted = curve(np.clip(u - shift_us, 0.0, largest))
    return Curve(basis, np.linalg.lstsq(basis.design(u), wanted, rcond=None)[0])

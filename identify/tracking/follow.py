"""One trial followed: what was expected, what it said, what is expected next, and what a person should know of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np

from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.identify.simulation.predict import refuse_rate
from stimrig.identify.tracking.carried import largest_change, moved_model, passed, rest_before, rested, with_states
from stimrig.identify.tracking.state import LEVELS, QUANTITIES, USUAL, Rates, State, Values, updated
from stimrig.identify.tracking.trial import Seen, curve_covariance, look

UNEXPLAINED = 4.0
"""An error so many times what the approved model left is not one of gain, threshold or speed."""
GONE = 0.25
"""Where less of the expected torque came, something came loose: no muscle changes so much from trial to trial."""
ENOUGH = 0.05
"""Of the model's largest torque: so much the expected one must vary for that to be told."""
LITTLE = np.array([0.05, 5.0, 0.08])
"""A trial that would tell none of the levels to within such a standard deviation tells little."""

USUAL_REST_S = 15.0
"""Rest after the first trial, as it is expected: in the one before it the model was approved."""


Bounds = Mapping[str, Sequence[float]]


class Outcome(StrEnum):
    """What became of a trial."""

    FOLLOWED = "followed"
    LITTLE = "little"
    """It tells little: too short, too weak, or too uneven."""
    ODD = "odd"
    """It is far from what was expected, or something else happened in it. It moves little or nothing."""
    NO_TORQUE = "no-torque"
    """The pulses gave next to no torque: an electrode or a cable is loose. It moves nothing."""
    CONTRADICTS = "contradicts"
    """Gain, threshold and speed do not explain two trials running: the structure is no longer the model's."""


@dataclass(frozen=True)
class Step:
    """One trial followed.

    `effects` holds by effect id its slow state at the trial's end, `now`, and as expected at the begin of the next one,
    `coming`, after a rest as long as the one before this trial, but at most `USUAL_REST_S` if that was the first.
    """

    outcome: Outcome  # what became of it
    seen: Seen  # what the trial said by itself
    before: State  # what was expected of it
    after: State  # what is known after it
    coming: State  # what is expected of the next trial: of this the controller is told
    distance: float | None  # squared, of what was seen from what was expected, in sd; None if it moved nothing
    effects: dict[str, dict[str, float]] = field(default_factory=dict)

    @property
    def coming_effects(self) -> dict[str, float]:
        """By effect id, its slow state as expected at the begin of the next trial."""
        return {effect: states["coming"] for effect, states in self.effects.items()}

    @property
    def disturbed_s(self) -> list[list[float]]:
        """Stretches from which nothing should be learnt, s since the record's begin: all of a trial that is odd."""
        if self.outcome in (Outcome.ODD, Outcome.NO_TORQUE, Outcome.CONTRADICTS):
            return [[0.0, self.seen.duration_s]]
        return [list(stretch) for stretch in self.seen.disturbed]

    def to_dict(self) -> dict[str, Any]:
        """As JSON: the levels of this trial and of the next with their bands, and what people may ask."""
        return {
            "outcome": str(self.outcome),
            "trial": self.after.trials,
            "now": levels_of(self.after),
            "coming": levels_of(self.coming),
            "error_nm": self.seen.error_nm,
            "expected_error_nm": self.seen.expected_nm,
            "error_before_nm": self.seen.before_nm,
            "torque_nm": self.seen.torque_nm,
            "disturbed_s": self.disturbed_s,
            "distance": self.distance,
            "effects": self.effects,
            "state": self.coming.to_dict(),
        }


def levels_of(state: State) -> dict[str, dict[str, float]]:
    """`value`, `low` and `high` (95 %) of each tracked quantity."""
    values = state.values
    found = {}
    for place, name in enumerate(QUANTITIES):
        low, high = state.band(place)
        found[name] = {"value": float(getattr(values, name)), "low": low, "high": high}
    return found


def begin(model: Model, rates: Rates = USUAL, test: Record | None = None) -> State:
    """What is expected of the first trial after the approval of a model; with the record of the `test` before it, what
    that has done to the muscle.
    """
    state = State.start(curve_covariance(model), rates)
    return state if test is None else passed(model, state, test)


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
        `stimrig.identify.simulation.predict.problem_of`.
    BadRecord
        The record is too short, or sampled more slowly than the pulses.
    """
    refuse_rate(model, record)
    before = begin(model, rates) if state is None else state
    rest_s = rest_before(before, record, rest_s)
    begun = rested(model, before.effects, rest_s)
    seen = look(with_states(model, begun), before, record)
    if seen.came < GONE and seen.wanted_nm > ENOUGH * float(np.ptp(model.recruitment.table()[1])):
        after, distance, outcome = replace(before, trials=before.trials + 1), None, Outcome.NO_TORQUE
    elif not (seen.misfit <= UNEXPLAINED):
        after, distance = replace(before, trials=before.trials + 1, unexplained=before.unexplained + 1), None
        outcome = Outcome.CONTRADICTS if after.unexplained > 1 else Outcome.ODD
    else:
        after, distance = updated(before, seen.vector, seen.information)
        outcome = Outcome.ODD if after.odd is not None else _told(seen)
    after = passed(model, replace(after, effects=begun), record, 0.0)
    next_s = rest_s if before.trials or rest_s is None else min(rest_s, USUAL_REST_S)
    coming = rested(model, after.effects, next_s)
    effects = {effect: {"now": now, "coming": coming[effect]} for effect, now in after.effects.items()}
    return Step(outcome, seen, before, after, after.ahead(rates), distance, effects)


def _told(seen: Seen) -> Outcome:
    own = seen.information[:LEVELS, :LEVELS] + np.diag(1e-3 / LITTLE**2)
    little = np.all(np.sqrt(np.diag(np.linalg.inv(own))) > LITTLE)
    return Outcome.LITTLE if little else Outcome.FOLLOWED


def model_for_next(model: Model, step: Step, bounds: Bounds | None = None) -> Model:
    """The approved model as it is expected to be in the next trial, as far as it may move.

    Parameters
    ----------
    model : Model
        The approved one.
    step : Step
        What the last trial said.
    bounds : mapping of str to (float, float), optional
        Least and most of each quantity that may move; the others stay as approved. All three are followed
        nevertheless: one that was held would be taken for a change of the others. By default all move freely.
        Whether the expected values themselves are inside, the caller has to look.
    """
    coming = step.coming
    if bounds is None:
        return moved_model(model, coming.values, coming.curve_nm, step.coming_effects)
    values = replace(Values(), **{name: getattr(coming.values, name) for name in QUANTITIES if name in bounds})
    low, high = bounds.get("gain", (1.0, 1.0))
    # The torque of every pulse stays within what the gain may be; if it does not, the curve keeps its shape.
    away = values.gain * largest_change(model, coming.curve_nm)
    inside = low <= values.gain - away and values.gain + away <= high
    return moved_model(model, values, coming.curve_nm if inside else 0.0, step.coming_effects)

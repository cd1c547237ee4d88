"""One trial followed: what was expected, what it said, what is expected next, and what a person should know of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from identify.model import Model
from identify.records.record import Record
from identify.simulation.predict import refuse_rate
from identify.tracking.served import largest_change, moved_model
from identify.tracking.state import LEVELS, QUANTITIES, USUAL, Rates, State, Values, updated
from identify.tracking.trial import Seen, curve_covariance, look

UNEXPLAINED = 4.0
"""An error so many times what the approved model left is not one of gain, threshold or speed."""
GONE = 0.25
"""Where less of the expected torque came, something came loose: no muscle changes so much from trial to trial."""
ENOUGH = 0.05
"""Of the model's largest torque: so much the expected one must vary for that to be told."""
LITTLE = np.array([0.05, 5.0, 0.08])
"""A trial that would tell none of the levels to within such a standard deviation tells little."""


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

    Parameters
    ----------
    outcome : Outcome
        What became of it.
    seen : Seen
        What the trial said by itself.
    before, after : State
        What was expected of it; what is known after it.
    coming : State
        What is expected of the next trial: of this the controller is told.
    distance : float or None
        Squared distance of what was seen from what was expected, in standard deviations; None if it moved nothing.
    """

    outcome: Outcome
    seen: Seen
    before: State
    after: State
    coming: State
    distance: float | None

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


def begin(model: Model, rates: Rates = USUAL) -> State:
    """What is expected of the first trial after the approval of a model."""
    return State.start(curve_covariance(model), rates)


def follow(model: Model, state: State | None, record: Record, rates: Rates = USUAL) -> Step:
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

    Raises
    ------
    BadModel
        The model's dynamics are not of second order, the record's pulse rate is another one, or see
        `identify.simulation.predict.problem_of`.
    BadRecord
        The record is too short, or sampled more slowly than the pulses.
    """
    refuse_rate(model, record)
    before = begin(model, rates) if state is None else state
    seen = look(model, before, record)
    if seen.came < GONE and seen.wanted_nm > ENOUGH * float(np.ptp(model.recruitment.table()[1])):
        after = replace(before, trials=before.trials + 1)
        return Step(Outcome.NO_TORQUE, seen, before, after, after.ahead(rates), None)
    if seen.misfit > UNEXPLAINED:
        after = replace(before, trials=before.trials + 1, unexplained=before.unexplained + 1)
        outcome = Outcome.CONTRADICTS if after.unexplained > 1 else Outcome.ODD
        return Step(outcome, seen, before, after, after.ahead(rates), None)
    after, distance = updated(before, seen.vector, seen.information)
    outcome = Outcome.ODD if after.odd is not None else _told(seen)
    return Step(outcome, seen, before, after, after.ahead(rates), distance)


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
        return moved_model(model, coming.values, coming.curve_nm)
    values = replace(Values(), **{name: getattr(coming.values, name) for name in QUANTITIES if name in bounds})
    low, high = bounds.get("gain", (1.0, 1.0))
    # The torque of every pulse stays within what the gain may be; if it does not, the curve keeps its shape.
    away = values.gain * largest_change(model, coming.curve_nm)
    inside = low <= values.gain - away and values.gain + away <= high
    return moved_model(model, values, coming.curve_nm if inside else 0.0)

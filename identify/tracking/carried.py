"""The slow states of an approved model's effects (fatigue, potentiation), carried through a session's pulses and rests.

Such a state x goes from 0 (rested) to 1. The pulses fill it by the effect's own law, with the gain and the threshold as
they are tracked; rests empty it. What the effect does not explain of a trial, the tracked gain takes up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from identify.dynamics.make_grid import make_grid
from identify.effects import registry
from identify.effects.base import Form, Scene
from identify.model import Model
from identify.model_schema import parameter_value
from identify.records.record import Record
from identify.tracking.forms import placed
from identify.tracking.state import State

CLOCK_S = 0.1
"""By so much a record may seem to begin before the end of the one before it: clocks are set."""


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
        As `identify.tracking.look`, of any pulse rate.
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

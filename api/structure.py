"""Words for a model's structure, and for the test that decides on it.

A structure is a model's method, order and set of effects; here it is named by its effects, each `id` or `id:form`. None
of them: the plain structure, f(u) and then G of second order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

PLAIN = "plain"


def held_by(model: Any | None, record: Any) -> list[str]:
    """The effects of a model with their forms, as a diagnosis of this record takes them; none for no model.

    Raises IdentifyError: the model holds for another pulse rate, or effects do not stand on it.
    """
    from stimrig.identify.diagnosis import structure_of
    from stimrig.identify.problem.predict import refuse_rate

    if model is not None:
        refuse_rate(model, record)
    return [effect.removesuffix(":") for effect in structure_of(model)]


def in_words(structure: Sequence[str]) -> str:
    """For people: "plain", or "fatigue (fitness), tremor"."""
    pairs = (effect.partition(":") for effect in structure)
    return ", ".join(f"{name} ({form})" if form else name for name, _, form in pairs) or PLAIN


def worded(experiment: str) -> str:
    """An experiment's sentence without the figure that only its ranking needs."""
    return experiment.split(": expected log evidence")[0].rstrip(".") + "." if experiment else ""

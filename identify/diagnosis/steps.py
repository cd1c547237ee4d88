"""The models of a search one after the other, each with one effect more, and their fit statistics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from identify.diagnosis.search import EffectSearch
from identify.estimation.evaluation import evaluate
from identify.estimation.joint import Fitted
from identify.estimation.renewed_curve import knows_joint, renewed_curve


@dataclass(frozen=True)
class Step:
    """One of these models.

    Parameters
    ----------
    added : str or None
        The effect that this model has more than the one before; None for the base.
    fitted : Fitted
        The model.
    statistics : dict
        See `identify.estimation.evaluation`.
    """

    added: str | None
    fitted: Fitted
    statistics: dict[str, Any]


def steps(search: EffectSearch) -> list[Step]:
    """The base, then the detected effects, then the effects found, in this order.

    The search compares models with one and the same curve. Once it is over, those in which it found what the joint
    does choose their curve with all rows; a base that knew of the joint has done so before.
    """
    models = [search.base, *search.with_detected, *search.chain[1:]]
    if not knows_joint(search.base):
        models = list(map(renewed_curve, models))
    return [
        Step(name, fitted, evaluate(fitted))
        for name, fitted in zip([None, *search.detected, *search.added], models, strict=True)
    ]

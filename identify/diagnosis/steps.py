"""The models of a search one after the other, each with one effect more, and their fit statistics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from identify.diagnosis.search import EffectSearch
from identify.estimation.evaluation import evaluate
from identify.estimation.joint import Fitted
from identify.estimation.renewed_curve import renewed_curve


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

    The search compares models with one and the same curve. Once it is over, each may choose its curve with all rows.
    """
    models = map(renewed_curve, [search.base, *search.with_detected, *search.chain[1:]])
    return [
        Step(name, fitted, evaluate(fitted))
        for name, fitted in zip([None, *search.detected, *search.added], models, strict=True)
    ]

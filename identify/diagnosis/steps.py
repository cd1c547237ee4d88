"""The models of an analysis one after the other, each with one effect more, and their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from identify.diagnosis.analysis import Analysis
from identify.estimation.joint import Fitted
from identify.estimation.statistics import statistics


@dataclass(frozen=True)
class Step:
    """One model of the row.

    Parameters
    ----------
    added : str or None
        The effect that this model has more than the one before; None for the base.
    fitted : Fitted
        The model.
    figures : dict
        See `identify.estimation.statistics`.
    """

    added: str | None
    fitted: Fitted
    figures: dict[str, Any]


def steps(work: Analysis) -> list[Step]:
    """Base, what the samples gave, what was found, in this order."""
    models = [work.base, *work.with_given, *work.chain[1:]]
    return [
        Step(name, fitted, statistics(fitted))
        for name, fitted in zip([None, *work.given, *work.added], models, strict=True)
    ]

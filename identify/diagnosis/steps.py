"""The models of an analysis one after the other, each with one effect more, and their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from identify.diagnosis.analysis import Analysis
from identify.effects import get
from identify.estimation.adding import names
from identify.estimation.joint import Fitted, solve, start_from
from identify.estimation.statistics import statistics
from identify.simulation.problem import Problem


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
    last = work.last
    result = [Step(None, work.base, statistics(work.base))]
    previous = work.base
    held = names(work.base)
    further = [*work.given, *work.added]
    for number, name in enumerate(further):
        fitted = last if number == len(further) - 1 else _part(last, previous, [*held, *further[: number + 1]])
        result.append(Step(name, fitted, statistics(fitted)))
        previous = fitted
    return result


def _part(last: Fitted, previous: Fitted, kept: list[str]) -> Fitted:
    """The last model with only some of its effects, from where they stand in it."""
    effects = [(effect, form) for effect, form in last.effects if effect in kept]
    problem = Problem(last.problem.setup, effects)
    banded = any(get(name).band for name in kept)
    noise = last.noise if banded else previous.noise
    return solve(problem, start_from(problem, last, {}), noise)

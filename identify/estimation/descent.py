"""One damped search for all least squares: a step that makes it worse is damped more, and tried again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Point = TypeVar("Point")
Trial = Callable[[float], Point | None]
"""The point a step away at some damping; None where no further step is worth it."""


@dataclass(frozen=True)
class Damping:
    """How a search is damped.

    Parameters
    ----------
    first : float
        At the first step.
    less, least : float
        It is divided by `less` after a step that helped, to `least` at the smallest.
    more, raised : float
        It is multiplied by `more` after one that did not, to `raised` at least.
    patience : int
        Steps in a row that do not help, after which the search ends; it also ends where the damping is above 1e8.
    """

    first: float
    less: float
    more: float
    least: float = 0.0
    raised: float = 0.0
    patience: int = 1000


@dataclass(frozen=True)
class Search(Generic[Point]):
    """What is searched.

    Parameters
    ----------
    damping : Damping
        Of its steps.
    trials : callable
        From a point, the number of the step and the damping to the trial steps there; None where the search ends.
    gain : callable
        What a trial gains over the point before; None where it is worse.
    settled : callable
        Whether the search ends after a step that gained so much; with the step's number. By default it never does.
    """

    damping: Damping
    trials: Callable[[Point, int, float], Trial[Point] | None]
    gain: Callable[[Point, Point], float | None]
    settled: Callable[[float, int], bool] = lambda _gained, _step: False


def descend(search: Search[Point], at: Point, most: int) -> tuple[Point, int]:
    """Search from a point, in at most so many steps: where it ends, and the number of steps begun until then."""
    rule = search.damping
    damping = rule.first
    for step in range(1, most + 1):
        trial = search.trials(at, step, damping)
        found, gain, failed = None, None, 0
        while trial is not None and failed < rule.patience and damping < 1e8:
            if (found := trial(damping)) is None or (gain := search.gain(at, found)) is not None:
                break
            damping, failed = max(rule.more * damping, rule.raised), failed + 1
        if found is None or gain is None:
            return at, step
        at, damping = found, max(damping / rule.less, rule.least)
        if search.settled(gain, step):
            return at, step
    return at, most

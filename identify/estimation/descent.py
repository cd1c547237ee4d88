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
    """Damping rule of a search."""

    first: float  # at the first step
    less: float  # a step that helped divides it by this
    more: float  # one that did not help multiplies it by this
    smallest: float = 0.0  # lower bound of the damping after a step that helped
    raised: float = 0.0  # after one that did not help it is this at least
    patience: int = 1000
    """Steps in a row that do not help, after which the search ends; it also ends where the damping is above 1e8."""


@dataclass(frozen=True)
class Search(Generic[Point]):
    """Functions and damping that define a search."""

    damping: Damping  # of its steps
    trials: Callable[[Point, int, float], Trial[Point] | None]
    """From a point, the number of the step and the damping to the trial steps there; None where the search ends."""
    gain: Callable[[Point, Point], float | None]  # what a trial gains over the point before; None where it is worse
    settled: Callable[[float, int], bool] = lambda _gained, _step: False
    """True if the search ends after a step, from its gain and its number. By default it never does."""


def descend(search: Search[Point], at: Point, max_steps: int) -> tuple[Point, int]:
    """Search from a point, in at most so many steps: where it ends, and the number of steps begun until then."""
    rule = search.damping
    damping = rule.first
    for step in range(1, max_steps + 1):
        trial = search.trials(at, step, damping)
        candidate, gain, failed = None, None, 0
        while trial is not None and failed < rule.patience and damping < 1e8:
            if (candidate := trial(damping)) is None or (gain := search.gain(at, candidate)) is not None:
                break
            damping, failed = max(rule.more * damping, rule.raised), failed + 1
        if candidate is None or gain is None:
            return at, step
        at, damping = candidate, max(damping / rule.less, rule.smallest)
        if search.settled(gain, step):
            return at, step
    return at, max_steps

"""Mechanism of a muscle of other physics: one kernel, its draws, and the right answers of a diagnosis.

The kernel stands between the recruited torque (a share of the largest, pulse by pulse) and the torque.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from numpy.random import Generator

from stimrig.hardware_sim.hidden.base import Base
from stimrig.hardware_sim.hidden.kernels import Kernel, kernel

TERM_PLACES = (
    "width that acts",
    "strength",
    "rate of the first lag",
    "rate of the second lag",
    "torque at the cell",
)
"""Where a term of the free effect may stand; torque at the cell: added or as a factor."""


@dataclass(frozen=True)
class Mechanism:
    """A kernel whose p[0] scales its torque, p[1:] are drawn between bounds (log-uniform where both are positive).

    `true` are the effects of a library that are in it by its equations; another name is untrue. `place`, of
    `TERM_PLACES`, is where it departs from the plain structure: two where either can be defended, none where it departs
    in more.
    """

    kernel: Kernel
    source: str
    draws: Mapping[str, tuple[float, float]]
    true: frozenset[str]
    place: frozenset[str]

    def draw(self, rng: Generator, base: Base) -> dict[str, float]:
        """Draw its numbers, as its kernel takes them.

        What ends in `_us_share` is drawn as a share of the way from 10 to 90 % recruitment, and given as a width in µs.
        """
        values = {}
        for name, (low, high) in self.draws.items():
            value = math.exp(rng.uniform(math.log(low), math.log(high))) if low > 0.0 else rng.uniform(low, high)
            values[name] = float(value)
        low_us, high_us = base.rise_us()
        return {
            name: low_us + value * (high_us - low_us) if name.endswith("_us_share") else value
            for name, value in values.items()
        }


def by_name(*mechanisms: Mechanism) -> dict[str, Mechanism]:
    """Return mechanisms by the names of their kernels' functions."""
    return {each.kernel.function.__name__: each for each in mechanisms}


def mechanism(
    source: str, true: str, place: str, **draws: tuple[float, float]
) -> Callable[[Callable[..., float]], Mechanism]:
    """Make a function the kernel of a mechanism; `true` by spaces, `place` by commas."""
    places = frozenset(filter(None, place.split(", ")))
    if not places <= set(TERM_PLACES):
        raise ValueError(f"{place}: words of {', '.join(TERM_PLACES)}")
    return lambda function: Mechanism(kernel("dynamics")(function), source, draws, frozenset(true.split()), places)

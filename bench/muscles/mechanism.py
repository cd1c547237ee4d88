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

ENTERS = ("drive", "rate of rise", "rate of fall", "output", "zero")
"""Where the plain structure, a static curve before linear dynamics, can be departed from."""
DRIVEN_BY = ("width", "activation", "torque", "time since", "sum of the past", "angle")
"""Inputs of a departure. Activation: the recruited share, or calcium; time since: the last pulse or train."""


@dataclass(frozen=True)
class Mechanism:
    """A kernel whose p[0] scales its torque, p[1:] are drawn between bounds (log-uniform where both are positive).

    `true` are the effects of a library that are in it by its equations; another name is untrue. `enters`, of `ENTERS`,
    and `driven_by`, of `DRIVEN_BY`, are the right answers to where it departs from the plain structure, and by what.
    """

    kernel: Kernel
    source: str
    draws: Mapping[str, tuple[float, float]]
    true: frozenset[str]
    enters: frozenset[str]
    driven_by: frozenset[str]

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
    source: str, true: str, enters: str, driven_by: str, **draws: tuple[float, float]
) -> Callable[[Callable[..., float]], Mechanism]:
    """Make a function the kernel of a mechanism; `true` by spaces, `enters` and `driven_by` by commas."""
    where, what = frozenset(enters.split(", ")), frozenset(driven_by.split(", "))
    if not (where <= set(ENTERS) and what <= set(DRIVEN_BY)):
        raise ValueError(f"{enters}; {driven_by}: words of {', '.join(ENTERS)}; {', '.join(DRIVEN_BY)}")
    true_names = frozenset(true.split())
    return lambda function: Mechanism(kernel("dynamics")(function), source, draws, true_names, where, what)

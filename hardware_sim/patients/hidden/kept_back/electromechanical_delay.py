"""Delay of two parts."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import STEP_S, Formulation, Stage, kernel


@kernel
def _onset(x, p, s, c):
    """p: delay s, share of it that is a lag. s[0]: place in the ring, s[1]: the lag's state."""
    size = 700
    i = int(s[0])
    s[10 + i] = x
    s[0] = (i + 1) % size
    late = min(p[0] * (1.0 - p[1]) / c[STEP_S], 690.0)
    whole = int(late)
    a = s[10 + (i - whole) % size]
    b = s[10 + (i - whole - 1) % size]
    x = a + (late - whole) * (b - a)
    if p[0] > 0.0:
        s[1] += (x - s[1]) * (1.0 - math.exp(-c[STEP_S] / (p[0] * p[1])))
        return s[1]
    return x


def onset(rng: Generator, _base: Base) -> Formulation:
    share = float(rng.uniform(0.15, 0.45))
    return Formulation(
        "conduction, then a lag of the series elastic element",
        "parts of the electromechanical delay, Nordez et al. 2009",
        lambda m: [Stage("delay", _onset, (m, share))],
        0.13,
        "delay_s",
        {"lag_share": share},
    )


FORMULATIONS = (onset,)

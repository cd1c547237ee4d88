"""Delay that jitters: the answer comes now sooner, now later, at random."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import STEP_S, Formulation, Stage, kernel, normal


@kernel
def _jitter(x, p, s, c):
    """p: mean delay s, its correlation s. s: place in the ring of 800, delay's state, generator."""
    size = 800
    i = int(s[0])
    s[10 + i] = x
    s[0] = (i + 1) % size
    s[1] += -c[STEP_S] * s[1] / p[1] + math.sqrt(2.0 * c[STEP_S] / p[1]) * normal(s, 2)
    late = min(max(p[0] * (1.0 + 0.8 * s[1]), 0.0) / c[STEP_S], 780.0)
    whole = int(late)
    a = s[10 + (i - whole) % size]
    b = s[10 + (i - whole - 1) % size]
    return a + (late - whole) * (b - a)


def jitter(rng: Generator, _base: Base) -> Formulation:
    correlation, seed = float(rng.uniform(0.3, 2.0)), int(rng.integers(1, 2**31))
    return Formulation(
        "delay wanders at random",
        "made to be foreign",
        lambda m: [Stage("delay", _jitter, (m, correlation), (0.0, 0.0, seed))],
        0.16,
        "mean_delay_s",
        {"correlation_s": correlation},
    )


FORMULATIONS = (jitter,)

"""Voluntary effort as a random process."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import STEP_S, Formulation, Stage, kernel, normal


@kernel
def _moods(x, p, s, c):
    """p: size N·m, correlation s, threshold. s: two lags of noise, generator. Effort where the process is high."""
    h = c[STEP_S]
    s[0] += -h * s[0] / p[1] + math.sqrt(2.0 * h / p[1]) * normal(s, 3)
    s[1] += h * (s[0] - s[1]) / 0.25
    drive = max(s[1] - p[2], 0.0)
    s[2] += h * (drive - s[2]) / 0.15
    return x + p[0] * s[2]


def moods(rng: Generator, _base: Base) -> Formulation:
    correlation, threshold, seed = (
        float(rng.uniform(1.5, 4.0)),
        float(rng.uniform(0.6, 1.2)),
        int(rng.integers(1, 2**31)),
    )
    return Formulation(
        "effort whenever a slow random drive is high",
        "no law",
        lambda m: [Stage("additive", _moods, (m, correlation, threshold), (0.0, 0.0, 0.0, seed))],
        20.0,
        "size_nm",
        {"correlation_s": correlation, "threshold": threshold},
    )


FORMULATIONS = (moods,)

"""Sensor gain that swings: warmth from a heating cycle changes the load cell's sensitivity, not its zero."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel


@kernel
def _swing(x, p, s, c):
    """p: depth, period s, phase, sharpness."""
    wave = math.sin(2.0 * math.pi * c[TIME_S] / p[1] + p[2])
    return x * (1.0 + p[0] * math.tanh(p[3] * wave) / math.tanh(p[3]))


def swing(rng: Generator, _base: Base) -> Formulation:
    period, phase = float(rng.uniform(3.0, 9.0)), float(rng.uniform(0.0, 2.0 * math.pi))
    sharp = float(rng.uniform(0.2, 4.0))
    return Formulation(
        "sensitivity swings in time",
        "heating cycle; made to be foreign",
        lambda m: [Stage("sensor", _swing, (m, period, phase, sharp))],
        0.8,
        "depth",
        {"period_s": period, "sharpness": sharp},
    )


FORMULATIONS = (swing,)

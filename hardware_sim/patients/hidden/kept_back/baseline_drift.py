"""Baseline drift that slows down."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel


@kernel
def _logarithmic(x, p, s, c):
    """p: N·m a decade, first time s."""
    return x + p[0] * math.log10(1.0 + c[TIME_S] / p[1])


@kernel
def _swing(x, p, s, c):
    """p: N·m, period s, phase: half a turn or more of a slow swing of the room's temperature."""
    return x + p[0] * (math.sin(2.0 * math.pi * c[TIME_S] / p[1] + p[2]) - math.sin(p[2]))


def logarithmic(rng: Generator, _base: Base) -> Formulation:
    first, sign = float(rng.uniform(1.0, 8.0)), float(rng.choice([-1.0, 1.0]))
    return Formulation(
        "creep with the logarithm of time",
        "load-cell creep",
        lambda m: [Stage("additive", _logarithmic, (sign * m, first))],
        4.0,
        "nm_per_decade",
        {"first_s": first, "sign": sign},
    )


def swing(rng: Generator, _base: Base) -> Formulation:
    period, phase = float(rng.uniform(50.0, 110.0)), float(rng.uniform(0.0, 2.0 * math.pi))
    return Formulation(
        "slow swing",
        "room temperature",
        lambda m: [Stage("additive", _swing, (m, period, phase))],
        4.0,
        "amplitude_nm",
        {"period_s": period},
    )


FORMULATIONS = (logarithmic, swing)

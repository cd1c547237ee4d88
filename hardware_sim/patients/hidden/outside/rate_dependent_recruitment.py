"""Rate-dependent recruitment: how many fibres answer goes with how quickly the pulse width has just changed."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import STEP_S, WIDTH_US, Formulation, Stage, kernel


@kernel
def _accommodation(x, p, s, c):
    """p: share, time constant s. s[0]: the width the nerve is used to. What differs from it counts more (or less)."""
    s[0] += (x - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    return max(x + p[0] * (x - s[0]), 0.0) if x > 0.0 else 0.0


@kernel
def _less_when_quick(x, p, s, c):
    """p: share lost at most, time constant s, µs/s at which half is lost. s: width before, mean speed of change."""
    s[1] += (abs(c[WIDTH_US] - s[0]) / c[STEP_S] - s[1]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    s[0] = c[WIDTH_US]
    return x * (1.0 - p[0] * s[1] / (s[1] + p[2]))


def _log_uniform(rng: Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def accommodation(rng: Generator, _base: Base) -> Formulation:
    tau, sign = _log_uniform(rng, 0.1, 0.6), float(rng.choice([-1.0, 1.0], p=[0.3, 0.7]))
    return Formulation(
        "the nerve accommodates to the width",
        "accommodation, Hill 1936, transposed to pulse width",
        lambda m: [Stage("electrode", _accommodation, (sign * m, tau))],
        1.5,
        "share",
        {"time_constant_s": tau, "sign": sign},
    )


def less_when_quick(rng: Generator, _base: Base) -> Formulation:
    tau, half = float(rng.uniform(0.15, 0.6)), float(rng.uniform(500.0, 2500.0))
    return Formulation(
        "quick changes of width recruit less",
        "no law; recruitment that depends on the rate of change",
        lambda m: [Stage("gain", _less_when_quick, (m, tau, half))],
        0.95,
        "share",
        {"time_constant_s": tau, "half_us_per_s": half},
    )


FORMULATIONS = (accommodation, less_when_quick)

"""Torque-velocity by a logistic curve."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import VELOCITY_RAD_S, Formulation, Stage, kernel, random_sign


@kernel
def _logistic(x, p, s, c):
    """p: steepness s/rad (signed), plateau of the stretched muscle."""
    e = math.exp(-4.0 * p[0] * c[VELOCITY_RAD_S])
    return x * p[1] * e / (p[1] - 1.0 + e)


def logistic(rng: Generator, _base: Base) -> Formulation:
    sign, plateau = random_sign(rng, 0.7), float(rng.uniform(1.4, 1.9))
    return Formulation(
        "logistic curve",
        "smooth stand-in for Hill's hyperbola",
        lambda m: [Stage("joint", _logistic, (sign * m, plateau))],
        0.8,
        "steepness_s",
        {"sign": sign, "plateau": plateau},
    )


FORMULATIONS = (logistic,)

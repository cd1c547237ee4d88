"""Torque-angle by a cubic."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ANGLE_RAD, Formulation, Stage, kernel


@kernel
def _cubic(x, p, s, c):
    """p: exponent, then coefficients of a cubic in rad from 90°."""
    d = c[ANGLE_RAD] - 0.5 * math.pi
    return x * max(1.0 + d * (p[1] + d * (p[2] + d * p[3])), 0.05) ** p[0]


def cubic(rng: Generator, _base: Base) -> Formulation:
    numbers = (
        float(rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.5)),
        -float(rng.uniform(0.2, 0.8)),
        float(rng.uniform(-0.2, 0.2)),
    )
    return Formulation(
        "cubic in the angle",
        "elbow torque-angle polynomials",
        lambda m: [Stage("joint", _cubic, (m, *numbers))],
        4.0,
        "exponent",
        {"coefficients": list(numbers)},
    )


FORMULATIONS = (cubic,)

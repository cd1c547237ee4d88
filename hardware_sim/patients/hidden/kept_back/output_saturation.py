"""Output saturation by a hyperbola."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import LARGEST_NM, Formulation, Stage, kernel


@kernel
def _hyperbola(x, p, s, c):
    """p: largest torque over the half-saturation torque."""
    if x <= 0.0:
        return x
    return x / (1.0 + p[0] * x / c[LARGEST_NM])


@kernel
def _arctangent(x, p, s, c):
    """p: largest torque over the knee."""
    if p[0] <= 0.0:
        return x
    knee = c[LARGEST_NM] / p[0]
    return knee * math.atan(x / knee)


def hyperbola(_rng: Generator, _base: Base) -> Formulation:
    return Formulation(
        "hyperbola", "Hill 1910", lambda m: [Stage("structure", _hyperbola, (m,))], 5.0, "largest_over_half"
    )


def arctangent(_rng: Generator, _base: Base) -> Formulation:
    return Formulation(
        "arctangent", "textbook", lambda m: [Stage("structure", _arctangent, (m,))], 5.0, "largest_over_knee"
    )


FORMULATIONS = (hyperbola, arctangent)

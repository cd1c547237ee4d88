"""Passive torque by a tangent."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ANGLE_RAD, VELOCITY_RAD_S, Formulation, Stage, kernel


@kernel
def _tangent(x, p, s, c):
    """p: size N·m, range rad, viscous share, exponent of the velocity."""
    d = min(max((c[ANGLE_RAD] - 0.5 * math.pi) / p[1], -0.95), 0.95)
    v = c[VELOCITY_RAD_S]
    return x - p[0] * (math.tan(0.5 * math.pi * d) + p[2] * math.copysign(abs(v) ** p[3], v))


def tangent(rng: Generator, _base: Base) -> Formulation:
    numbers = float(rng.uniform(1.1, 1.6)), float(rng.uniform(0.1, 1.0)), float(rng.uniform(0.7, 1.2))
    return Formulation(
        "tangent of the angle and a power of the velocity",
        "stiffening towards both ends",
        lambda m: [Stage("additive", _tangent, (m, *numbers))],
        4.0,
        "size_nm",
        dict(zip(("range_rad", "viscous_share", "velocity_exponent"), numbers, strict=True)),
    )


FORMULATIONS = (tangent,)

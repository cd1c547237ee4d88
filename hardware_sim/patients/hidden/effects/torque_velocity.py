"""Torque-velocity: active torque falls as the muscle shortens and rises as it is stretched."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ANGLE_RAD, VELOCITY_RAD_S, Formulation, Stage, kernel, random_sign


@kernel
def _hill(x, p, s, c):
    """p: inverse of the largest velocity s/rad (signed: shortening positive), shape, eccentric plateau."""
    v = p[0] * c[VELOCITY_RAD_S]
    if v >= 0.0:
        return x * max(1.0 - v, 0.0) / (1.0 + v / p[1])
    slope = 1.0 + 1.0 / p[1]  # same slope on both sides of rest
    gain = p[2] - 1.0
    return x * (1.0 + gain * slope * -v / (gain + slope * -v))


@kernel
def _logarithmic(x, p, s, c):
    """p: inverse of the largest velocity. De Groote's d1 log(d2 v + d3 + sqrt((d2 v + d3)² + 1)) + d4."""
    v = -p[0] * c[VELOCITY_RAD_S]
    value = -0.318 * math.asinh(-8.149 * v - 0.374) + 0.886
    return x * max(value / (-0.318 * math.asinh(-0.374) + 0.886), 0.0)


@kernel
def _angle_times_velocity(x, p, s, c):
    """p: share lost per rad/s at the angle where it is most, V2 per degree."""
    degrees = c[ANGLE_RAD] * 180.0 / math.pi
    bell = p[1] * degrees * math.exp(1.0 - p[1] * degrees)
    return x * max(1.0 - p[0] * bell * c[VELOCITY_RAD_S], 0.0)


def _sign(rng: Generator) -> float:
    return random_sign(rng, 0.7)


def hill(rng: Generator, _base: Base) -> Formulation:
    sign, shape, plateau = _sign(rng), float(rng.uniform(0.2, 0.6)), float(rng.uniform(1.3, 1.8))
    return Formulation(
        "Hill's hyperbola with an eccentric branch",
        "Hill 1938; Katz 1939",
        lambda m: [Stage("joint", _hill, (sign * m, shape, plateau))],
        1.0,
        "inverse_largest_velocity_s",
        {"shortening": "extension" if sign > 0 else "flexion", "shape": shape, "eccentric_plateau": plateau},
    )


def logarithmic(rng: Generator, _base: Base) -> Formulation:
    sign = _sign(rng)
    return Formulation(
        "logarithmic force-velocity curve",
        "De Groote, Kinney, Rao and Fregly 2016",
        lambda m: [Stage("joint", _logarithmic, (sign * m,))],
        1.0,
        "inverse_largest_velocity_s",
        {"shortening": "extension" if sign > 0 else "flexion"},
    )


def angle_times_velocity(rng: Generator, _base: Base) -> Formulation:
    sign, v2 = _sign(rng), float(rng.uniform(0.015, 0.03))
    return Formulation(
        "velocity times a bell of the angle",
        "Marion, Wexler and Hull 2010",
        lambda m: [Stage("joint", _angle_times_velocity, (sign * m, v2))],
        1.5,
        "share_lost_per_rad_s",
        {"V2_per_degree": v2, "sign": sign},
    )


FORMULATIONS = (hill, logarithmic, angle_times_velocity)

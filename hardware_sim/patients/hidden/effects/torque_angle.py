"""Torque-angle: active torque depends on the elbow's angle."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ANGLE_RAD, Formulation, Stage, kernel


@kernel
def _parabola(x, p, s, c):
    """p: exponent, linear per degree, quadratic per degree². In degrees from 90°."""
    d = 90.0 - c[ANGLE_RAD] * 180.0 / math.pi
    return x * max(1.0 + p[1] * d - p[2] * d * d, 0.05) ** p[0]


@kernel
def _force_length(x, p, s, c):
    """p: exponent, fibre lengths per rad, angle of the best length, width of the bell."""
    stretch = p[1] * (c[ANGLE_RAD] - p[2])
    best = p[1] * (0.5 * math.pi - p[2])
    return x * math.exp(-p[0] * (stretch * stretch - best * best) / (p[3] * p[3]))


@kernel
def _moment_arm(x, p, s, c):
    """p: exponent, angle of the largest arm. The tendon's moment arm goes with the sine."""
    arm = max(math.cos(c[ANGLE_RAD] - p[1]), 0.05) / math.cos(0.5 * math.pi - p[1])
    return x * arm ** p[0]


def parabola(_rng: Generator, _base: Base) -> Formulation:
    return Formulation(
        "parabola about 90 degrees",
        "Marion, Wexler and Hull 2010",
        lambda m: [Stage("joint", _parabola, (m, 0.0344, 4.49e-4))],
        1.3,
        "exponent",
    )


def force_length(rng: Generator, _base: Base) -> Formulation:
    per_rad, best = float(rng.uniform(0.3, 0.6)), float(rng.uniform(1.0, 2.1))
    width = math.sqrt(float(rng.uniform(0.2, 0.45)))
    return Formulation(
        "Gaussian force-length curve",
        "Thelen 2003 (width γ 0.45)",
        lambda m: [Stage("joint", _force_length, (m, per_rad, best, width))],
        8.0,
        "exponent",
        {"lengths_per_rad": per_rad, "best_angle_rad": best, "width": width},
    )


def moment_arm(rng: Generator, _base: Base) -> Formulation:
    at = float(0.5 * math.pi + rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 0.6))
    return Formulation(
        "moment arm goes with the sine",
        "Murray, Delp and Buchanan 1995, simplified",
        lambda m: [Stage("joint", _moment_arm, (m, at))],
        5.0,
        "exponent",
        {"best_angle_rad": at},
    )


FORMULATIONS = (parabola, force_length, moment_arm)

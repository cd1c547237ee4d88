"""Output saturation: large torques are rounded off after the dynamics, by tendon or fixture."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import LARGEST_NM, Formulation, Stage, kernel


@kernel
def _tanh(x, p, s, c):
    """p: largest torque over the knee."""
    if p[0] <= 0.0:
        return x
    knee = c[LARGEST_NM] / p[0]
    return knee * math.tanh(x / knee)


@kernel
def _power(x, p, s, c):
    """p: largest torque over the limit, exponent. x / (1 + (x/limit)^p)^(1/p)."""
    if p[0] <= 0.0:
        return x
    limit = c[LARGEST_NM] / p[0]
    return x / (1.0 + (abs(x) / limit) ** p[1]) ** (1.0 / p[1])


@kernel
def _tendon(x, p, s, c):
    """p: exponent at the largest torque. Torque lost where the tendon stretches: (1 - exp(-k x)) / k."""
    if p[0] < 1e-9:
        return x
    k = p[0] / c[LARGEST_NM]
    return (1.0 - math.exp(-k * x)) / k


@kernel
def _knee(x, p, s, c):
    """p: torque of the knee over the largest torque, slope lost above it, roundness. Softplus knee."""
    at, width = p[0] * c[LARGEST_NM], p[2] * c[LARGEST_NM]
    z = (x - at) / width
    z0 = -at / width
    above = width * (max(z, 0.0) + math.log1p(math.exp(-abs(z))) - math.log1p(math.exp(z0)))
    return x - p[1] * above


def tanh(_rng: Generator, _base: Base) -> Formulation:
    return Formulation("tanh", "textbook", lambda m: [Stage("structure", _tanh, (m,))], 4.0, "largest_over_knee")


def power(rng: Generator, _base: Base) -> Formulation:
    exponent = float(rng.uniform(1.5, 6.0))
    return Formulation(
        "x / (1 + x^p)^(1/p)",
        "Naka and Rushton 1966, generalised",
        lambda m: [Stage("structure", _power, (m, exponent))],
        4.0,
        "largest_over_limit",
        {"exponent": exponent},
    )


def tendon(_rng: Generator, _base: Base) -> Formulation:
    return Formulation(
        "tendon with an exponential toe",
        "after the series elastic element of Zajac 1989",
        lambda m: [Stage("structure", _tendon, (m,))],
        4.0,
        "exponent",
    )


def knee(rng: Generator, _base: Base) -> Formulation:
    at, roundness = float(rng.uniform(0.35, 0.6)), float(rng.uniform(0.02, 0.08))
    return Formulation(
        "two slopes with a soft knee",
        "bilinear fixture stiffness",
        lambda m: [Stage("structure", _knee, (at, m, roundness))],
        0.97,
        "slope_lost",
        {"knee_share": at, "roundness": roundness},
    )


FORMULATIONS = (tanh, power, tendon, knee)

"""Series compliance: fixture, splint or tendon ring between the muscle and the load cell."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import LARGEST_NM, STEP_S, Formulation, Stage, helper, kernel


@helper
def _resonate(x, omega, damping, stiffening, s, step_s):
    """Displacement s[0] (in N·m of a linear spring) and its velocity s[1]; the spring's torque is returned.

    The input is taken as a straight line from s[2] to `x` over the step, so that a stiff spring is transparent.
    """
    pieces = int(omega * step_s / 0.05) + 1
    h = step_s / pieces
    before = s[2]
    spring = s[0] * (1.0 + stiffening * s[0] * s[0])
    for i in range(pieces):
        drive = before + (x - before) * (i + 0.5) / pieces
        s[1] += h * (omega * omega * (drive - spring) - 2.0 * damping * omega * s[1])
        s[0] += h * s[1]
        spring = s[0] * (1.0 + stiffening * s[0] * s[0])
    s[2] = x
    return spring


@kernel
def _in_series(x, p, s, c):
    """p: 1/ω² s², ζ, stiffening at the largest torque."""
    if p[0] < 1e-8:
        return x
    return _resonate(x, 1.0 / math.sqrt(p[0]), p[1], p[2] / (c[LARGEST_NM] * c[LARGEST_NM]), s, c[STEP_S])


@kernel
def _beside(x, p, s, c):
    """p: share that goes through the mode, its Hz, ζ."""
    return x + p[0] * (_resonate(x, 2.0 * math.pi * p[1], p[2], 0.0, s, c[STEP_S]) - x)


@kernel
def _anti_resonance(x, p, s, c):
    """p: size, Hz, ζ: the load cell also feels the mass's acceleration, y = x - size * x_mode'' / ω²."""
    omega = 2.0 * math.pi * p[1]
    speed = s[1]
    _resonate(x, omega, p[2], 0.0, s, c[STEP_S])
    return x - p[0] * (s[1] - speed) / c[STEP_S] / (omega * omega)


def mass_and_spring(rng: Generator, _base: Base) -> Formulation:
    damping = float(np.exp(rng.uniform(np.log(0.03), np.log(0.3))))
    return Formulation(
        "mass on a spring",
        "load cell and splint as a single mode",
        lambda m: [Stage("structure", _in_series, (m, damping, 0.0))],
        0.02,
        "inverse_omega_squared_s2",
        {"zeta": damping},
    )


def stiffening(rng: Generator, _base: Base) -> Formulation:
    damping, stiff = float(rng.uniform(0.04, 0.3)), float(rng.uniform(0.3, 2.5))
    return Formulation(
        "mass on a spring that stiffens",
        "tendon toe region, Zajac 1989",
        lambda m: [Stage("structure", _in_series, (m, damping, stiff))],
        0.02,
        "inverse_omega_squared_s2",
        {"zeta": damping, "stiffening": stiff},
    )


def beside(rng: Generator, _base: Base) -> Formulation:
    hz, damping = float(rng.uniform(1.5, 6.0)), float(rng.uniform(0.03, 0.2))
    return Formulation(
        "part of the torque goes through the mode",
        "two-mode fixture",
        lambda m: [Stage("structure", _beside, (m, hz, damping))],
        1.0,
        "share",
        {"frequency_hz": hz, "zeta": damping},
    )


def acceleration(rng: Generator, _base: Base) -> Formulation:
    hz, damping = float(rng.uniform(1.5, 6.0)), float(rng.uniform(0.03, 0.2))
    return Formulation(
        "the load cell feels the forearm's acceleration",
        "inertial torque of a compliant splint",
        lambda m: [Stage("structure", _anti_resonance, (m, hz, damping))],
        2.0,
        "size",
        {"frequency_hz": hz, "zeta": damping},
    )


FORMULATIONS = (mass_and_spring, stiffening, beside, acceleration)

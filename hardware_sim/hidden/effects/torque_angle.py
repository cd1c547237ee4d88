"""Torque-angle: active torque depends on the elbow's angle."""

from __future__ import annotations

import math

from stimrig.hardware_sim.hidden.forms import Effect, draws
from stimrig.hardware_sim.hidden.kernels import ANGLE_RAD

EFFECT = Effect(moving=True)


def _best_rad(rng, _base):
    return float(0.5 * math.pi + rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 0.6))


def _coefficients(rng, _base):
    first = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.5))
    return [first, -float(rng.uniform(0.2, 0.8)), float(rng.uniform(-0.2, 0.2))]


@EFFECT.form("parabola about 90 degrees", "Marion, Wexler and Hull 2010")
@draws("joint", 1.3, "exponent", _linear=0.0344, _quadratic=4.49e-4)
def _parabola(x, p, s, c):
    """p: exponent, linear per degree, quadratic per degree². In degrees from 90°."""
    d = 90.0 - c[ANGLE_RAD] * 180.0 / math.pi
    return x * max(1.0 + p[1] * d - p[2] * d * d, 0.05) ** p[0]


@EFFECT.form("Gaussian force-length curve", "Thelen 2003 (width γ 0.45)")
@draws(
    "joint",
    8.0,
    "exponent",
    lengths_per_rad=(0.3, 0.6),
    best_angle_rad=(1.0, 2.1),
    width=lambda rng, _base: math.sqrt(float(rng.uniform(0.2, 0.45))),
)
def _force_length(x, p, s, c):
    """p: exponent, fibre lengths per rad, angle of the best length, width of the bell."""
    stretch = p[1] * (c[ANGLE_RAD] - p[2])
    best = p[1] * (0.5 * math.pi - p[2])
    return x * math.exp(-p[0] * (stretch * stretch - best * best) / (p[3] * p[3]))


@EFFECT.form("moment arm goes with the sine", "Murray, Delp and Buchanan 1995, simplified")
@draws("joint", 5.0, "exponent", best_angle_rad=_best_rad)
def _moment_arm(x, p, s, c):
    """p: exponent, angle of the largest arm. The tendon's moment arm goes with the sine."""
    arm = max(math.cos(c[ANGLE_RAD] - p[1]), 0.05) / math.cos(0.5 * math.pi - p[1])
    return x * arm ** p[0]


@EFFECT.held_back("cubic in the angle", "elbow torque-angle polynomials")
@draws("joint", 4.0, "exponent", coefficients=_coefficients)
def _cubic(x, p, s, c):
    """p: exponent, then coefficients of a cubic in rad from 90°."""
    d = c[ANGLE_RAD] - 0.5 * math.pi
    return x * max(1.0 + d * (p[1] + d * (p[2] + d * p[3])), 0.05) ** p[0]

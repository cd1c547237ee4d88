"""Output saturation: large torques are rounded off after the dynamics, by tendon or fixture."""

from __future__ import annotations

import math

from stimrig.hardware_sim.hidden.forms import Effect, draws
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM

EFFECT = Effect()


@EFFECT.form("tanh", "textbook")
@draws("structure", 4.0, "largest_over_knee")
def _tanh(x, p, s, c):
    knee = c[LARGEST_NM] / p[0]
    return knee * math.tanh(x / knee)


@EFFECT.form("x / (1 + x^p)^(1/p)", "Naka and Rushton 1966, generalised")
@draws("structure", 4.0, "largest_over_limit", exponent=(1.5, 6.0))
def _power(x, p, s, c):
    """p: largest torque over the limit, exponent. x / (1 + (x/limit)^p)^(1/p)."""
    limit = c[LARGEST_NM] / p[0]
    return x / (1.0 + (abs(x) / limit) ** p[1]) ** (1.0 / p[1])


@EFFECT.form("tendon with an exponential toe", "after the series elastic element of Zajac 1989")
@draws("structure", 4.0, "exponent")
def _tendon(x, p, s, c):
    """p: exponent at the largest torque. Torque lost where the tendon stretches: (1 - exp(-k x)) / k."""
    k = p[0] / c[LARGEST_NM]
    return (1.0 - math.exp(-k * x)) / k


@EFFECT.form("two slopes with a soft knee", "bilinear fixture stiffness")
@draws("structure", 0.97, "slope_lost", knee_share=(0.35, 0.6), roundness=(0.02, 0.08))
def _knee(x, p, s, c):
    """p: slope lost above the knee, torque of the knee over the largest torque, roundness. Softplus knee."""
    at, width = p[1] * c[LARGEST_NM], p[2] * c[LARGEST_NM]
    z = (x - at) / width
    z0 = -at / width
    above = width * (max(z, 0.0) + math.log1p(math.exp(-abs(z))) - math.log1p(math.exp(z0)))
    return x - p[0] * above


@EFFECT.held_back("hyperbola", "Hill 1910")
@draws("structure", 5.0, "largest_over_half")
def _hyperbola(x, p, s, c):
    if x <= 0.0:
        return x
    return x / (1.0 + p[0] * x / c[LARGEST_NM])


@EFFECT.held_back("arctangent", "textbook")
@draws("structure", 5.0, "largest_over_knee")
def _arctangent(x, p, s, c):
    knee = c[LARGEST_NM] / p[0]
    return knee * math.atan(x / knee)

"""Passive torque: tissue resists movement without any stimulation."""

from __future__ import annotations

import math

from stimrig.hardware_sim.hidden.forms import Effect, Numbers, draws
from stimrig.hardware_sim.hidden.kernels import ANGLE_RAD, STEP_S, VELOCITY_RAD_S

EFFECT = Effect(moving=True)


def _spring(rng, _base):
    per_rad = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 0.7))
    slack = 0.5 * math.pi - math.copysign(float(rng.uniform(0.1, 0.6)), per_rad)
    return Numbers((per_rad, slack), lengths_per_rad=per_rad, slack_rad=slack)


@EFFECT.form("exponential spring and dashpot", "De Groote, Kinney, Rao and Fregly 2016")
@draws("additive", 8.0, "size_nm", _spring=_spring, viscous_share_s=(0.1, 0.6))
def _exponential(x, p, s, c):
    """p: size N·m, fibre lengths per rad (signed), angle of slack, viscosity as a share of the size, per rad/s."""
    stretch = p[1] * (c[ANGLE_RAD] - p[2])
    elastic = (math.exp(4.0 * stretch / 0.6) - 1.0) / (math.exp(4.0) - 1.0) if stretch > 0.0 else 0.0
    return x - p[0] * (elastic * math.copysign(4.0, p[1]) + p[3] * c[VELOCITY_RAD_S])


@EFFECT.form("exponentials at both ends of the range", "Hatze 1997; Riener and Edrich 1999")
@draws(
    "additive",
    6.0,
    "size_nm",
    flexed_per_rad=(2.0, 5.0),
    flexed_rad=(0.8, 1.3),
    extended_per_rad=(2.0, 5.0),
    extended_rad=(1.8, 2.3),
    viscous_s=(0.1, 0.6),
)
def _two_ends(x, p, s, c):
    """p: size, steepness per rad and angle of the flexed and of the extended end, viscosity share."""
    flexed = math.exp(-p[1] * (c[ANGLE_RAD] - p[2]))
    extended = math.exp(p[3] * (c[ANGLE_RAD] - p[4]))
    return x + p[0] * (flexed - extended - p[5] * c[VELOCITY_RAD_S])


@EFFECT.form("spring, dashpot and some dry friction", "Ashworth-like stiffness, linear")
@draws("additive", 5.0, "size_nm", stiffness=(0.6, 1.4), viscosity_s=(0.2, 0.8), dry=(0.0, 0.25))
def _friction(x, p, s, c):
    v = c[VELOCITY_RAD_S]
    return x - p[0] * (p[1] * (c[ANGLE_RAD] - 0.5 * math.pi) + p[2] * v + p[3] * math.tanh(v / 0.05))


@EFFECT.form("standard linear solid", "Fung 1981")
@draws("additive", 6.0, "stiffness_nm_per_rad", lasting_share=(0.3, 0.7), relaxation_s=(0.4, 2.0))
def _relaxing(x, p, s, c):
    """p: size, lasting stiffness share, relaxation time s. s: the dashpot's angle. A standard linear solid."""
    angle = c[ANGLE_RAD] - 0.5 * math.pi
    if s[1] == 0.0:
        s[0], s[1] = angle, 1.0
    s[0] += c[STEP_S] * (angle - s[0]) / p[2]
    return x - p[0] * (p[1] * angle + (1.0 - p[1]) * (angle - s[0]))


@EFFECT.held_back("tangent of the angle and a power of the velocity", "stiffening towards both ends")
@draws("additive", 4.0, "size_nm", range_rad=(1.1, 1.6), viscous_share=(0.1, 1.0), velocity_exponent=(0.7, 1.2))
def _tangent(x, p, s, c):
    d = min(max((c[ANGLE_RAD] - 0.5 * math.pi) / p[1], -0.95), 0.95)
    v = c[VELOCITY_RAD_S]
    return x - p[0] * (math.tan(0.5 * math.pi * d) + p[2] * math.copysign(abs(v) ** p[3], v))

"""Torque-velocity: active torque falls as the muscle shortens and rises as it is stretched."""

from __future__ import annotations

import math

from stimrig.hardware_sim.hidden.forms import Effect, Sign, draws, mostly
from stimrig.hardware_sim.hidden.kernels import ANGLE_RAD, VELOCITY_RAD_S

EFFECT = Effect(moving=True)
MOSTLY_EXTENSION = mostly(0.7)
SHORTENING = Sign(MOSTLY_EXTENSION, "extension", "flexion")


@EFFECT.form("Hill's hyperbola with an eccentric branch", "Hill 1938; Katz 1939")
@draws(
    "joint", 1.0, "inverse_largest_velocity_s", shortening=SHORTENING, shape=(0.2, 0.6), eccentric_plateau=(1.3, 1.8)
)
def _hill(x, p, s, c):
    v = p[0] * c[VELOCITY_RAD_S]
    if v >= 0.0:
        return x * max(1.0 - v, 0.0) / (1.0 + v / p[1])
    slope = 1.0 + 1.0 / p[1]  # same slope on both sides of rest
    gain = p[2] - 1.0
    return x * (1.0 + gain * slope * -v / (gain + slope * -v))


@EFFECT.form("logarithmic force-velocity curve", "De Groote, Kinney, Rao and Fregly 2016")
@draws("joint", 1.0, "inverse_largest_velocity_s", shortening=SHORTENING)
def _logarithmic(x, p, s, c):
    """p: inverse of the largest velocity. De Groote's d1 log(d2 v + d3 + sqrt((d2 v + d3)² + 1)) + d4."""
    v = -p[0] * c[VELOCITY_RAD_S]
    value = -0.318 * math.asinh(-8.149 * v - 0.374) + 0.886
    return x * max(value / (-0.318 * math.asinh(-0.374) + 0.886), 0.0)


@EFFECT.form("velocity times a bell of the angle", "Marion, Wexler and Hull 2010")
@draws("joint", 1.5, "share_lost_per_rad_s", sign=Sign(MOSTLY_EXTENSION), V2_per_degree=(0.015, 0.03))
def _angle_times_velocity(x, p, s, c):
    """p: share lost per rad/s at the angle where it is most, V2 per degree."""
    degrees = c[ANGLE_RAD] * 180.0 / math.pi
    bell = p[1] * degrees * math.exp(1.0 - p[1] * degrees)
    return x * max(1.0 - p[0] * bell * c[VELOCITY_RAD_S], 0.0)


@EFFECT.held_back("logistic curve", "smooth stand-in for Hill's hyperbola")
@draws("joint", 0.8, "steepness_s", sign=Sign(MOSTLY_EXTENSION), plateau=(1.4, 1.9))
def _logistic(x, p, s, c):
    e = math.exp(-4.0 * p[0] * c[VELOCITY_RAD_S])
    return x * p[1] * e / (p[1] - 1.0 + e)

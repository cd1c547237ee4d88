"""Series compliance: fixture, splint or tendon ring between the muscle and the load cell."""

from __future__ import annotations

import math

import numpy as np

from stimrig.hardware_sim.hidden.forms import Effect, draws
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, STEP_S, helper

EFFECT = Effect()


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


@EFFECT.form("mass on a spring", "load cell and splint as a single mode")
@draws(
    "structure",
    0.02,
    "inverse_omega_squared_s2",
    zeta=lambda rng, _base: float(np.exp(rng.uniform(np.log(0.03), np.log(0.3)))),
    _stiffening=0.0,
)
def _in_series(x, p, s, c):
    """p: 1/ω² s², ζ, stiffening at the largest torque."""
    return _resonate(x, 1.0 / math.sqrt(p[0]), p[1], p[2] / (c[LARGEST_NM] * c[LARGEST_NM]), s, c[STEP_S])


EFFECT.form("mass on a spring that stiffens", "tendon toe region, Zajac 1989", zeta=(0.04, 0.3), stiffening=(0.3, 2.5))(
    _in_series
)


@EFFECT.form("part of the torque goes through the mode", "two-mode fixture")
@draws("structure", 1.0, "share", frequency_hz=(1.5, 6.0), zeta=(0.03, 0.2))
def _parallel_mode(x, p, s, c):
    return x + p[0] * (_resonate(x, 2.0 * math.pi * p[1], p[2], 0.0, s, c[STEP_S]) - x)


@EFFECT.form("the load cell feels the forearm's acceleration", "inertial torque of a compliant splint")
@draws("structure", 2.0, "size", frequency_hz=(1.5, 6.0), zeta=(0.03, 0.2))
def _anti_resonance(x, p, s, c):
    """p: size, Hz, ζ: the load cell also feels the mass's acceleration, y = x - size * x_mode'' / ω²."""
    omega = 2.0 * math.pi * p[1]
    speed = s[1]
    _resonate(x, omega, p[2], 0.0, s, c[STEP_S])
    return x - p[0] * (s[1] - speed) / c[STEP_S] / (omega * omega)


@EFFECT.held_back("two masses in a row", "forearm and splint, a mode each")
@draws("structure", 0.02, "inverse_omega_squared_s2", zeta=(0.05, 0.25), second_over_first=(2.0, 4.0))
def _chain(x, p, s, c):
    """p: 1/ω² s², ζ, second ω over first. s: two displacements and speeds.

    Muscle pulls the first mass against the second, the load cell holds the second: x -> m1 -> spring -> m2 -> cell.
    """
    omega = 1.0 / math.sqrt(p[0])
    second = omega * p[2]
    pieces = int(second * c[STEP_S] / 0.05) + 1
    h = c[STEP_S] / pieces
    for i in range(pieces):
        drive = s[4] + (x - s[4]) * (i + 0.5) / pieces
        first = s[0] - s[2] + 2.0 * p[1] / omega * (s[1] - s[3])
        s[1] += h * omega * omega * (drive - first)
        s[3] += h * second * second * (first - s[2] - 2.0 * p[1] / second * s[3])
        s[0] += h * s[1]
        s[2] += h * s[3]
    s[4] = x
    return s[2] + 2.0 * p[1] / second * s[3]

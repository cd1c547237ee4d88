"""Fatigue: the torque a given recruitment yields falls with use and comes back with rest."""

from __future__ import annotations

import numpy as np

from stimrig.hardware_sim.hidden.forms import Effect, Numbers, draws
from stimrig.hardware_sim.hidden.kernels import ACTIVATION, FORCE, LARGEST_NM, SPEED, STEP_S

EFFECT = Effect("larger")


@EFFECT.form(
    lambda revealed: (
        "gain falls with force, fatigue slows the muscle" if revealed["slowing"] else "gain falls with force"
    ),
    "Ding, Wexler and Binder-Macleod 2003",
)
@draws("gain", 0.25, "alpha_per_s", tau_s=(40.0, 150.0), slowing=[0.0, 0.3, 0.8])
def _force_driven(x, p, s, c):
    """p: α per s, τ s, slowing. s[0]: share of the gain lost. Ding's dA/dt = -(A - A0)/τ + α F, α < 0."""
    s[0] += c[STEP_S] * (p[0] * c[FORCE] - s[0] / p[1])
    s[0] = min(max(s[0], 0.0), 0.95)
    c[SPEED] *= 1.0 / (1.0 + p[2] * s[0])
    return x * (1.0 - s[0])


@EFFECT.form(
    "three compartments: resting, active, fatigued",
    "Xia and Frey-Law 2008; rest factor Looft, Herkert and Frey-Law 2018",
)
@draws("gain", 0.3, "F_per_s", R_per_s=(0.004, 0.03), rest_factor=(1.0, 10.0))
def _three_compartments(x, p, s, c):
    """p: F per s, R per s, r. s[0]: fatigued share. Units work, tire, and rest into use again."""
    working = c[ACTIVATION] * (1.0 - s[0])
    recovery = p[1] * (p[2] if c[ACTIVATION] < 0.02 else 1.0)
    s[0] += c[STEP_S] * (p[0] * working - recovery * s[0])
    s[0] = min(max(s[0], 0.0), 0.98)
    return x * (1.0 - s[0])


UNITS = 24


def _rates(rng, _base):
    rate = np.sort(np.exp(rng.normal(0.0, 0.7, UNITS)))[::-1]  # large fast units come first under stimulation
    recovery = rng.uniform(0.01, 0.04, UNITS)
    return Numbers((*rate, *recovery), fastest_over_slowest=float(rate[0] / rate[-1]))


@EFFECT.form(
    "motor units tire one by one, the fast ones first",
    "after Potvin and Fuglevand 2017, reversed order as in Gregory and Bickel 2005",
)
@draws(
    "gain",
    0.3,
    "median_rate_per_s",
    arrange=lambda m, *numbers: (*(m * rate for rate in numbers[:UNITS]), *numbers[UNITS:]),
    _rates=_rates,
)
def _motor_units(x, p, s, c):
    """p[0:24]: rate of tiring of each unit, p[24:48]: of recovery. s: each unit's lost share, in recruitment order."""
    level = c[ACTIVATION] * 24.0
    torque = 0.0
    for i in range(24):
        on = min(max(level - i, 0.0), 1.0)
        s[i] += c[STEP_S] * (p[i] * on * (1.0 - s[i]) - p[24 + i] * s[i])
        torque += on * (1.0 - s[i])
    return torque / 24.0 * c[LARGEST_NM] + max(level - 24.0, 0.0) / 24.0 * c[LARGEST_NM]


@EFFECT.held_back("phosphate inhibits force", "inorganic phosphate, Allen, Lamb and Westerblad 2008")
@draws("gain", 0.5, "production_per_s", clearance_s=(25.0, 90.0), exponent=(1.0, 2.2))
def _phosphate(x, p, s, c):
    """p: production per s, clearance s, Hill exponent. s[0]: phosphate over the level that halves the force."""
    s[0] += c[STEP_S] * (p[0] * c[ACTIVATION] - s[0] / p[1])
    return x / (1.0 + s[0] ** p[2])

"""Baseline drift: the torque read at rest wanders (temperature, settling limb)."""

from __future__ import annotations

import math

import numpy as np

from stimrig.hardware_sim.hidden.forms import Effect, Sign, draws
from stimrig.hardware_sim.hidden.kernels import TIME_S, smooth_table

EFFECT = Effect()


def _knots(rng, _base):
    knots = np.concatenate([[0.0], np.cumsum(rng.normal(0.0, 1.0, 199))])
    return list(knots / np.abs(knots[:6]).max())


@EFFECT.form("bridge and amplifier warm up", "strain-gauge self-heating")
@draws(
    "additive",
    4.0,
    "final_offset_nm",
    arrange=lambda m, fast, slow, share: (m * share, fast, m * (1.0 - share), slow),
    sign=Sign(),
    tau_s=lambda rng, _base: [float(rng.uniform(4.0, 12.0)), float(rng.uniform(25.0, 90.0))],
    fast_share=(0.0, 0.6),
)
def _warm_up(x, p, s, c):
    """p: final offsets, N·m, and time constants, s, of bridge and amplifier."""
    return x + p[0] * (1.0 - math.exp(-c[TIME_S] / p[1])) + p[2] * (1.0 - math.exp(-c[TIME_S] / p[3]))


@EFFECT.form("linear", "temperature ramp")
@draws("additive", 0.2, "nm_per_s", sign=Sign())
def _linear(x, p, s, c):
    return x + p[0] * c[TIME_S]


@EFFECT.form("smooth random walk", "limb settling in the splint")
@draws("additive", 4.0, "largest_nm", knots_s=(9.0, 20.0), _knots=_knots)
def _wander(x, p, s, c):
    """p: size N·m, spacing of the knots s, 200 knots."""
    return x + p[0] * smooth_table(p, 2, 200, c[TIME_S] / p[1])


@EFFECT.held_back("creep with the logarithm of time", "load-cell creep")
@draws("additive", 4.0, "nm_per_decade", first_s=(1.0, 8.0), sign=Sign())
def _logarithmic(x, p, s, c):
    return x + p[0] * math.log10(1.0 + c[TIME_S] / p[1])


@EFFECT.held_back("slow swing", "room temperature")
@draws("additive", 4.0, "amplitude_nm", period_s=(50.0, 110.0), _phase=(0.0, 2.0 * math.pi))
def _swing(x, p, s, c):
    """p: N·m, period s, phase: half a turn or more of a slow swing of the room's temperature."""
    return x + p[0] * (math.sin(2.0 * math.pi * c[TIME_S] / p[1] + p[2]) - math.sin(p[2]))

"""Baseline drift: the torque read at rest wanders (temperature, settling limb)."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base
from stimrig.hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel, smooth_table
from stimrig.hardware_sim.patients.hidden.written import Sign, Written, even


@kernel("additive")
def _warm_up(x, p, s, c):
    """p: final offsets, N·m, and time constants, s, of bridge and amplifier."""
    return x + p[0] * (1.0 - math.exp(-c[TIME_S] / p[1])) + p[2] * (1.0 - math.exp(-c[TIME_S] / p[3]))


@kernel("additive")
def _linear(x, p, s, c):
    """p: N·m per s."""
    return x + p[0] * c[TIME_S]


@kernel("additive")
def _wander(x, p, s, c):
    """p: size N·m, spacing of the knots s, 200 knots."""
    return x + p[0] * smooth_table(p, 2, 200, c[TIME_S] / p[1])


@kernel("additive")
def _logarithmic(x, p, s, c):
    """p: N·m a decade, first time s."""
    return x + p[0] * math.log10(1.0 + c[TIME_S] / p[1])


@kernel("additive")
def _swing(x, p, s, c):
    """p: N·m, period s, phase: half a turn or more of a slow swing of the room's temperature."""
    return x + p[0] * (math.sin(2.0 * math.pi * c[TIME_S] / p[1] + p[2]) - math.sin(p[2]))


def warm_up(rng: Generator, _base: Base) -> Formulation:
    sign = even(rng)
    fast, slow, share = float(rng.uniform(4.0, 12.0)), float(rng.uniform(25.0, 90.0)), float(rng.uniform(0.0, 0.6))
    return Formulation(
        "bridge and amplifier warm up",
        "strain-gauge self-heating",
        lambda m: [Stage(_warm_up, (sign * m * share, fast, sign * m * (1.0 - share), slow))],
        4.0,
        "final_offset_nm",
        {"tau_s": [fast, slow], "fast_share": share, "sign": sign},
    )


def _knots(rng: Generator, _base: Base) -> list[float]:
    knots = np.concatenate([[0.0], np.cumsum(rng.normal(0.0, 1.0, 199))])
    return list(knots / np.abs(knots[:6]).max())


FORMULATIONS = (
    warm_up,
    Written("linear", "temperature ramp", _linear, 0.2, "nm_per_s", {"sign": Sign()}),
    Written(
        "smooth random walk",
        "limb settling in the splint",
        _wander,
        4.0,
        "largest_nm",
        {"knots_s": (9.0, 20.0), "_knots": _knots},
    ),
)
KEPT_BACK = (
    Written(
        "creep with the logarithm of time",
        "load-cell creep",
        _logarithmic,
        4.0,
        "nm_per_decade",
        {"first_s": (1.0, 8.0), "sign": Sign()},
    ),
    Written(
        "slow swing",
        "room temperature",
        _swing,
        4.0,
        "amplitude_nm",
        {"period_s": (50.0, 110.0), "_phase": (0.0, 2.0 * math.pi)},
    ),
)

"""Baseline drift: the torque read at rest wanders (temperature, settling limb)."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel, smooth_table


@kernel
def _warm_up(x, p, s, c):
    """p: final offsets, N·m, and time constants, s, of bridge and amplifier."""
    return x + p[0] * (1.0 - math.exp(-c[TIME_S] / p[1])) + p[2] * (1.0 - math.exp(-c[TIME_S] / p[3]))


@kernel
def _linear(x, p, s, c):
    """p: N·m per s."""
    return x + p[0] * c[TIME_S]


@kernel
def _wander(x, p, s, c):
    """p: size N·m, spacing of the knots s, 200 knots."""
    return x + p[0] * smooth_table(p, 2, 200, c[TIME_S] / p[1])


def warm_up(rng: Generator, _base: Base) -> Formulation:
    sign = float(rng.choice([-1.0, 1.0]))
    fast, slow, share = float(rng.uniform(4.0, 12.0)), float(rng.uniform(25.0, 90.0)), float(rng.uniform(0.0, 0.6))
    return Formulation(
        "bridge and amplifier warm up",
        "strain-gauge self-heating",
        lambda m: [Stage("additive", _warm_up, (sign * m * share, fast, sign * m * (1.0 - share), slow))],
        4.0,
        "final_offset_nm",
        {"tau_s": [fast, slow], "fast_share": share, "sign": sign},
    )


def linear(rng: Generator, _base: Base) -> Formulation:
    sign = float(rng.choice([-1.0, 1.0]))
    return Formulation(
        "linear",
        "temperature ramp",
        lambda m: [Stage("additive", _linear, (sign * m,))],
        0.2,
        "nm_per_s",
        {"sign": sign},
    )


def wander(rng: Generator, _base: Base) -> Formulation:
    spacing = float(rng.uniform(9.0, 20.0))
    knots = np.concatenate([[0.0], np.cumsum(rng.normal(0.0, 1.0, 199))])
    knots /= np.abs(knots[:6]).max()
    return Formulation(
        "smooth random walk",
        "limb settling in the splint",
        lambda m: [Stage("additive", _wander, (m, spacing, *knots))],
        4.0,
        "largest_nm",
        {"knots_s": spacing},
    )


FORMULATIONS = (warm_up, linear, wander)

"""Threshold drift: over minutes, the same pulse width reaches fewer or more nerve fibres."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel, random_sign, smooth_table


@kernel
def _warm_up(x, p, s, c):
    """p: shift µs, time constant s. An electrode that settles: the width lost goes to its end like an RC."""
    return max(x - p[0] * (1.0 - math.exp(-c[TIME_S] / p[1])), 0.0) if x > 0.0 else 0.0


@kernel
def _strength_duration(x, p, s, c):
    """p: change of the current's share, time constant s, overdrive I/rheobase at the start.

    Lapicque: a fibre answers where I >= Irh (1 + chronaxie/width), so a change of I scales every threshold width by
    the ratio of (I/Irh - 1).
    """
    change = p[0] * (1.0 - math.exp(-c[TIME_S] / p[1]))
    return max(x * (p[2] * (1.0 + change) - 1.0) / (p[2] - 1.0), 0.0)


@kernel
def _wander(x, p, s, c):
    """p: size µs, spacing of the knots s, then 200 knots: sweat and skin, without a law."""
    if x <= 0.0:
        return 0.0
    return max(x - p[0] * smooth_table(p, 2, 200, c[TIME_S] / p[1]), 0.0)


@kernel
def _linear(x, p, s, c):
    """p: µs per s, until (s)."""
    return max(x - p[0] * min(c[TIME_S], p[1]), 0.0) if x > 0.0 else 0.0


def _sign(rng: Generator) -> float:
    return random_sign(rng, 0.65)


def impedance(rng: Generator, _base: Base) -> Formulation:
    tau, sign = float(rng.uniform(10.0, 60.0)), _sign(rng)
    return Formulation(
        "electrode settles like an RC",
        "electrode-skin impedance, Dorgan and Reilly 1999",
        lambda m: [Stage("electrode", _warm_up, (sign * m, tau))],
        90.0,
        "final_shift_us",
        {"tau_s": tau, "sign": sign},
    )


def strength_duration(rng: Generator, _base: Base) -> Formulation:
    tau, sign, drive = float(rng.uniform(15.0, 80.0)), -_sign(rng), float(rng.uniform(1.6, 3.0))
    return Formulation(
        "current falls, thresholds scale by Lapicque's law",
        "Lapicque 1907; Geddes 2004",
        lambda m: [Stage("electrode", _strength_duration, (sign * m, tau, drive))],
        0.35,
        "share_of_current",
        {"tau_s": tau, "sign": sign, "current_over_rheobase": drive},
    )


def sweat(rng: Generator, _base: Base) -> Formulation:
    spacing, sign = float(rng.uniform(10.0, 18.0)), _sign(rng)
    steps = np.abs(rng.normal(1.0, 0.5, 199)) * np.exp(-np.arange(199) / 12.0)
    knots = np.concatenate([[0.0], np.cumsum(steps)])
    knots *= sign / knots[4]
    return Formulation(
        "smooth wander in one direction",
        "sweat and gel, no law",
        lambda m: [Stage("electrode", _wander, (m, spacing, *knots))],
        80.0,
        "shift_at_fourth_knot_us",
        {"knots_s": spacing, "sign": sign},
    )


def linear(rng: Generator, _base: Base) -> Formulation:
    sign, until = _sign(rng), float(rng.uniform(60.0, 200.0))
    return Formulation(
        "linear, then settled",
        "sim",
        lambda m: [Stage("electrode", _linear, (sign * m, until))],
        2.0,
        "us_per_s",
        {"sign": sign, "until_s": until},
    )


FORMULATIONS = (impedance, strength_duration, sweat, linear)

"""Plateau potentials: strong stimulation sets off an after-discharge that goes on by itself until it dies out."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ACTIVATION, LARGEST_NM, STEP_S, Formulation, Stage, kernel


@kernel
def _bistable(x, p, s, c):
    """p: size share, activation that sets it off, time it takes s, how long it lasts s. s: charge, age, on."""
    s[0] += (c[ACTIVATION] - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[2]))
    if s[2] < 0.5 and s[0] > p[1]:
        s[2] = 1.0
        s[1] = 0.0
    if s[2] > 0.5:
        s[1] += c[STEP_S]
        if s[1] > p[3]:
            s[2] = 0.0
            s[0] = 0.0
    return x + p[0] * c[LARGEST_NM] * s[2]


def bistable(rng: Generator, _base: Base) -> Formulation:
    threshold, takes = float(rng.uniform(0.4, 0.65)), float(rng.uniform(0.15, 0.5))
    lasts = float(rng.uniform(0.5, 1.8))
    return Formulation(
        "after-discharge switched on by strong stimulation",
        "plateau potentials, Bennett, Li and Siu 2001",
        lambda m: [Stage("gain", _bistable, (m, threshold, takes, lasts))],
        0.9,
        "size_share",
        {"threshold_share": threshold, "takes_s": takes, "lasts_s": lasts},
    )


FORMULATIONS = (bistable,)

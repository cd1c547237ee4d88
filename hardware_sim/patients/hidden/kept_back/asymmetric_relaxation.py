"""Relaxation with a linear phase."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base, lag_after
from hardware_sim.patients.hidden.kernels import FORCE, LARGEST_NM, STEP_S, Formulation, Stage, kernel


@kernel
def _limited_fall(x, p, s, c):
    """p: τ1, τ2, s it takes at least to fall from the largest torque. s: two lags; the second falls no faster."""
    before = s[0]
    s[0] += (x - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[0]))
    goal = lag_after(before, s[0], s[1], p[1], c[STEP_S])
    if p[2] > 0.0:
        fastest = c[STEP_S] * c[LARGEST_NM] / p[2]
        change = goal - s[1]
        goal = s[1] + (change if change > 0.0 else -fastest * math.tanh(-change / fastest))
    s[1] = goal
    c[FORCE] = s[1] / c[LARGEST_NM]
    return s[1]


def limited_fall(rng: Generator, base: Base) -> Formulation:
    fast, slow = base.two_lags_s()
    return Formulation(
        "torque falls no faster than the bridges let go",
        "linear phase of relaxation, Tesi, Piroddi, Colomo and Poggesi 2002",
        lambda m: [Stage("dynamics", _limited_fall, (fast, slow, m))],
        3.0,
        "shortest_fall_s",
    )


FORMULATIONS = (limited_fall,)

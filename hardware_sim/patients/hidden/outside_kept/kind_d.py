# ruff: noqa: ARG001 (every kernel takes the same four arguments)
"""Stimulation current that gets into the load cell's amplifier: the reading goes up with the width, at once."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import LARGEST_NM, STEP_S, WIDTH_US, Formulation, Stage, kernel


@kernel
def _feed_through(x, p, s, c):
    """p: share with its sign, largest width µs."""
    return x + p[0] * c[LARGEST_NM] * c[WIDTH_US] / p[1]


@kernel
def _edges(x, p, s, c):
    """p: share with its sign, largest width µs, decay s. s: the amplifier's slow copy of the artefact."""
    drive = c[WIDTH_US] / p[1]
    s[0] += (drive - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[2]))
    return x + p[0] * c[LARGEST_NM] * (drive - s[0])


def feed_through(rng: Generator, base: Base) -> Formulation:
    sign = float(rng.choice([-1.0, 1.0]))
    return Formulation(
        "artefact proportional to the width",
        "stimulus artefact in a bridge amplifier",
        lambda m: [Stage("sensor", _feed_through, (sign * m, float(base.largest_width_us)))],
        1.0,
        "share",
        {"sign": sign},
    )


def edges(rng: Generator, base: Base) -> Formulation:
    sign, decay = float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.05, 0.4))
    return Formulation(
        "artefact at changes of the width",
        "stimulus artefact through a coupling capacitor",
        lambda m: [Stage("sensor", _edges, (sign * m, float(base.largest_width_us), decay))],
        1.5,
        "share",
        {"sign": sign, "decay_s": decay},
    )


FORMULATIONS = (feed_through, edges)

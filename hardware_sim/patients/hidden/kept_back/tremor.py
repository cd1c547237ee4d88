"""Tremor as beats."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel


@kernel
def _beats(x, p, s, c):
    """p: size, then three pairs of Hz and phase. Close lines that beat, as of a few motor units."""
    for i in range(3):
        x += p[0] * math.sin(2.0 * math.pi * p[1 + 2 * i] * c[TIME_S] + p[2 + 2 * i])
    return x


def beats(rng: Generator, _base: Base) -> Formulation:
    centre = float(rng.uniform(3.4, 7.5))
    lines = np.column_stack([centre + rng.uniform(-0.35, 0.35, 3), rng.uniform(0.0, 2.0 * np.pi, 3)])
    return Formulation(
        "three close lines",
        "beating motor units, Elble and Koller 1990",
        lambda m: [Stage("additive", _beats, (m, *lines.ravel()))],
        3.0,
        "amplitude_nm",
        {"lines_hz": lines[:, 0].tolist()},
    )


FORMULATIONS = (beats,)

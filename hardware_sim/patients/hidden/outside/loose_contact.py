"""Loose contact: for moments no current flows, though pulses are sent."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base
from stimrig.hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel


@kernel("electrode")
def _gaps(x, p, s, c):
    """p: length of a typical gap s, then 200 pairs of instant and relative length. s[0]: present pair."""
    i = int(s[0])
    while i < 200 and c[TIME_S] >= p[1 + 2 * i] + p[0] * p[2 + 2 * i]:
        i += 1
    s[0] = i
    if i < 200 and c[TIME_S] >= p[1 + 2 * i]:
        return 0.0
    return x


def gaps(rng: Generator, _base: Base) -> Formulation:
    instants = np.cumsum(rng.uniform(0.6, 4.0, 200))
    table = np.column_stack([instants, rng.uniform(0.4, 1.6, 200)]).ravel()
    return Formulation(
        "current is cut for moments",
        "loose electrode lead",
        lambda m: [Stage(_gaps, (m, *table))],
        0.35,
        "typical_gap_s",
        {"first_instants_s": instants[:5].tolist()},
    )


FORMULATIONS = (gaps,)

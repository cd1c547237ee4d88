"""Jumps of gain: an electrode shifts at an instant and with it the share of the nerve it reaches."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base
from stimrig.hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel


@kernel("gain")
def _jumps(x, p, s, c):
    """p: size, then 60 pairs of instant and gain after it. s[0]: present pair."""
    while s[0] < 60.0 and c[TIME_S] >= p[1 + 2 * int(s[0])]:
        s[1] = p[2 + 2 * int(s[0])]
        s[0] += 1.0
    return x * max(1.0 + p[0] * s[1], 0.0)


def jumps(rng: Generator, _base: Base) -> Formulation:
    instants = float(rng.uniform(4.0, 10.0)) + np.cumsum(rng.uniform(3.0, 12.0, 60))
    gains = np.cumsum(np.where(np.arange(60) % 2 == 0, 1.0, -1.0) * rng.uniform(0.4, 1.6, 60))
    gains = np.clip(gains, -1.5, 1.5)
    table = np.column_stack([instants, gains]).ravel()
    return Formulation(
        "gain jumps up and down",
        "electrode shift",
        lambda m: [Stage(_jumps, (m, *table))],
        0.6,
        "size",
        {"first_instants_s": instants[:5].tolist(), "first_gains": gains[:5].tolist()},
    )


FORMULATIONS = (jumps,)

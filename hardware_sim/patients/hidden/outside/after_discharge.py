"""Plateau potentials: strong stimulation sets off an after-discharge that goes on by itself until it dies out."""

from __future__ import annotations

import math

from stimrig.hardware_sim.patients.hidden.kernels import ACTIVATION, LARGEST_NM, STEP_S, kernel
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("gain")
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


FORMULATIONS = (
    Written(
        "after-discharge switched on by strong stimulation",
        "plateau potentials, Bennett, Li and Siu 2001",
        _bistable,
        0.9,
        "size_share",
        {"threshold_share": (0.4, 0.65), "takes_s": (0.15, 0.5), "lasts_s": (0.5, 1.8)},
    ),
)

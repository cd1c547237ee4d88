"""Backlash in the fixture: the load cell follows the torque only after play has been taken up."""

from __future__ import annotations

import math

from stimrig.hardware_sim.patients.hidden.kernels import LARGEST_NM, STEP_S, kernel
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("structure")
def _play(x, p, s, c):
    """p: half-width of the play as a share of the largest torque, settling s. s: follower, what is read."""
    half = p[0] * c[LARGEST_NM]
    s[0] = min(max(s[0], x - half), x + half)
    s[1] += (s[0] - s[1]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    return s[1] if p[0] > 0.0 else x


FORMULATIONS = (
    Written(
        "play on torque",
        "backlash operator, Krasnosel'skii and Pokrovskii 1989",
        _play,
        0.4,
        "half_width_share",
        {"settling_s": (0.001, 0.01)},
    ),
)

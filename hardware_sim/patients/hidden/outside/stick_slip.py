"""Stick-slip: the limb sticks in the splint and the reading stays, then jumps."""

from __future__ import annotations

import math

from stimrig.hardware_sim.patients.hidden.kernels import LARGEST_NM, STEP_S, kernel
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("structure")
def _stick_slip(x, p, s, c):
    """p: breakaway as a share of the largest torque, share at which it sticks again, slip s. s: reading, slipping."""
    gap = p[0] * c[LARGEST_NM]
    if abs(x - s[0]) > gap:
        s[1] = 1.0
    if s[1] > 0.0:
        s[0] += (x - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[2]))
        if abs(x - s[0]) < p[1] * gap:
            s[1] = 0.0
    return s[0] if p[0] > 0.0 else x


FORMULATIONS = (
    Written(
        "breakaway and slip",
        "Coulomb friction with a breakaway torque",
        _stick_slip,
        0.6,
        "breakaway_share",
        {"sticks_again_share": (0.05, 0.3), "slip_s": (0.005, 0.04)},
    ),
)

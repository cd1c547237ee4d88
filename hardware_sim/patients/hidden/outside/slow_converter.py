"""A slow converter: the sensor holds each reading for a while, or rounds it coarsely."""

from __future__ import annotations

from stimrig.hardware_sim.patients.hidden.kernels import LARGEST_NM, TIME_S, kernel
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("converter")
def _held(x, p, s, c):
    """p: how long a reading is held, s. s: reading, time of the next."""
    if p[0] <= 0.0:
        return x
    if c[TIME_S] >= s[1]:
        s[0] = x
        s[1] += p[0]
    return s[0]


@kernel("converter")
def _coarse(x, p, s, c):
    """p: step as a share of the largest torque."""
    if p[0] <= 0.0:
        return x
    step = p[0] * c[LARGEST_NM]
    return round(x / step) * step


FORMULATIONS = (
    Written("each reading is held", "sample and hold", _held, 1.2, "held_s"),
    Written("coarse steps", "quantiser", _coarse, 0.6, "step_share"),
)

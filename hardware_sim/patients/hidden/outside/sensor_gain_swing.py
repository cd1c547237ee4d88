"""Sensor gain that swings: warmth from a heating cycle changes the load cell's sensitivity, not its zero."""

from __future__ import annotations

import math

from stimrig.hardware_sim.patients.hidden.kernels import TIME_S, kernel
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("sensor")
def _swing(x, p, s, c):
    """p: depth, period s, phase, sharpness."""
    wave = math.sin(2.0 * math.pi * c[TIME_S] / p[1] + p[2])
    return x * (1.0 + p[0] * math.tanh(p[3] * wave) / math.tanh(p[3]))


FORMULATIONS = (
    Written(
        "sensitivity swings in time",
        "heating cycle; made to be foreign",
        _swing,
        0.8,
        "depth",
        {"period_s": (3.0, 9.0), "_phase": (0.0, 2.0 * math.pi), "sharpness": (0.2, 4.0)},
    ),
)

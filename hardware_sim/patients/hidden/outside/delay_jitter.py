"""Delay that jitters: the answer comes now sooner, now later, at random."""

from __future__ import annotations

import math

from stimrig.hardware_sim.patients.hidden.base import delayed
from stimrig.hardware_sim.patients.hidden.kernels import STEP_S, kernel, normal
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("delay")
def _jitter(x, p, s, c):
    """p: mean delay s, its correlation s. s: place in the ring of 800, delay's state, generator."""
    s[1] += -c[STEP_S] * s[1] / p[1] + math.sqrt(2.0 * c[STEP_S] / p[1]) * normal(s, 2)
    return delayed(x, min(max(p[0] * (1.0 + 0.8 * s[1]), 0.0) / c[STEP_S], 780.0), s, 10, 800)


FORMULATIONS = (
    Written(
        "delay wanders at random",
        "made to be foreign",
        _jitter,
        0.16,
        "mean_delay_s",
        {"correlation_s": (0.3, 2.0)},
        seed_at=2,
    ),
)

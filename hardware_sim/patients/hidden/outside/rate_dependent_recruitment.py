"""Rate-dependent recruitment: how many fibres answer goes with how quickly the pulse width has just changed."""

from __future__ import annotations

import math

from stimrig.hardware_sim.patients.hidden.kernels import STEP_S, WIDTH_US, kernel
from stimrig.hardware_sim.patients.hidden.written import Sign, Written, weighted


@kernel("electrode")
def _accommodation(x, p, s, c):
    """p: share, time constant s. s[0]: the width the nerve is used to. What differs from it counts more (or less)."""
    s[0] += (x - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    return max(x + p[0] * (x - s[0]), 0.0) if x > 0.0 else 0.0


@kernel("gain")
def _less_when_quick(x, p, s, c):
    """p: share lost at most, time constant s, µs/s at which half is lost. s: width before, mean speed of change."""
    s[1] += (abs(c[WIDTH_US] - s[0]) / c[STEP_S] - s[1]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    s[0] = c[WIDTH_US]
    return x * (1.0 - p[0] * s[1] / (s[1] + p[2]))


FORMULATIONS = (
    Written(
        "the nerve accommodates to the width",
        "accommodation, Hill 1936, transposed to pulse width",
        _accommodation,
        1.5,
        "share",
        {
            "time_constant_s": lambda rng, _base: math.exp(rng.uniform(math.log(0.1), math.log(0.6))),
            "sign": Sign(weighted(0.3, 0.7)),
        },
    ),
    Written(
        "quick changes of width recruit less",
        "no law; recruitment that depends on the rate of change",
        _less_when_quick,
        0.95,
        "share",
        {"time_constant_s": (0.15, 0.6), "half_us_per_s": (500.0, 2500.0)},
    ),
)

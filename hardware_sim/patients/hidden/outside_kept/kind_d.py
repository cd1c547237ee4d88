# ruff: noqa: ARG001 (every kernel takes the same four arguments)
"""Stimulation current that gets into the load cell's amplifier: the reading goes up with the width, at once."""

from __future__ import annotations

import math

from stimrig.hardware_sim.patients.hidden.kernels import LARGEST_NM, STEP_S, WIDTH_US, kernel
from stimrig.hardware_sim.patients.hidden.written import Sign, Written, largest_width_us


@kernel("sensor")
def _feed_through(x, p, s, c):
    """p: share with its sign, largest width µs."""
    return x + p[0] * c[LARGEST_NM] * c[WIDTH_US] / p[1]


@kernel("sensor")
def _edges(x, p, s, c):
    """p: share with its sign, largest width µs, decay s. s: the amplifier's slow copy of the artefact."""
    drive = c[WIDTH_US] / p[1]
    s[0] += (drive - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[2]))
    return x + p[0] * c[LARGEST_NM] * (drive - s[0])


FORMULATIONS = (
    Written(
        "artefact proportional to the width",
        "stimulus artefact in a bridge amplifier",
        _feed_through,
        1.0,
        "share",
        {"sign": Sign(), "_largest": largest_width_us},
    ),
    Written(
        "artefact at changes of the width",
        "stimulus artefact through a coupling capacitor",
        _edges,
        1.5,
        "share",
        {"sign": Sign(), "_largest": largest_width_us, "decay_s": (0.05, 0.4)},
    ),
)

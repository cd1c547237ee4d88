"""Clonus: after a sudden change of torque the muscle beats by itself for a while."""

from __future__ import annotations

import math

from stimrig.hardware_sim.patients.hidden.kernels import ACTIVATION, LARGEST_NM, STEP_S, kernel
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("additive")
def _beats(x, p, s, c):
    """p: size share, Hz, drive's decay s, delay s. s: oscillator (2), drive, activation before.

    A Van der Pol oscillator whose energy supply is switched on by a fall of activation and dies away.
    """
    fall = s[3] - c[ACTIVATION]
    s[3] = c[ACTIVATION]
    if fall > 0.3:
        s[2] = 1.0
        s[0] += 0.3
    s[2] *= math.exp(-c[STEP_S] / p[2])
    omega = 2.0 * math.pi * p[1]
    grow = omega * (0.6 * s[2] - 0.15)
    for _ in range(4):
        h = 0.25 * c[STEP_S]
        s[1] += h * (2.0 * grow * (1.0 - s[0] * s[0]) * s[1] - omega * omega * s[0])
        s[0] += h * s[1]
    size = s[0] * s[0] + s[1] * s[1] / (omega * omega)
    if size > 9.0:
        s[0] *= 3.0 / math.sqrt(size)
        s[1] *= 3.0 / math.sqrt(size)
    return x + p[0] * c[LARGEST_NM] * max(s[0], -0.4) * min(s[2] * 3.0, 1.0)


FORMULATIONS = (
    Written(
        "beats set off by a fall of torque",
        "Van der Pol oscillator; clonus at 5 to 7 Hz, Hidler and Rymer 1999",
        _beats,
        0.8,
        "size_share",
        {"frequency_hz": (4.5, 7.5), "decay_s": (0.4, 1.5)},
    ),
)

"""Muscles of physics kept from whoever tunes the diagnosis; only the bench's set `sealed` draws them.

Their names tell nothing, on purpose. Don't read this while working on `identify`.
"""

from __future__ import annotations

import math

from stimrig.hardware_sim.hidden.base import lag_after
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, PULSE, STEP_S
from stimrig.hardware_sim.hidden.physics import mechanism


@mechanism(
    "a chain of sarcomeres of unequal strength on their length-tension curve: Morgan 1990, Campbell 2009",
    "asymmetric_relaxation series_compliance potentiation",
    activation_s=(0.03, 0.09),
    unequal=(0.05, 0.25),
    fastest_per_s=(0.5, 3.0),
    compliance=(0.05, 0.25),
    curved=(1.0, 6.0),
    passive=(0.5, 3.0),
)
def kept_a(x, p, s, c):
    """p: scale, activation s, spread of strength, lengths/s, spring's stretch, curve of length-tension, passive.

    s: two lags, 9 lengths beyond the optimum from s[10]. Total length and the spring's stretch add to a constant.
    """
    count = 9
    before = s[0]
    s[0] = lag_after(x / c[LARGEST_NM], x / c[LARGEST_NM], before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[1], c[STEP_S])
    force = 0.0
    for _ in range(6):
        shortened = 0.0
        for k in range(count):
            shortened -= s[10 + k] / count
        force = max(shortened / p[4], 0.0)
        for k in range(count):
            own = 1.0 + p[2] * (2.0 * k / (count - 1.0) - 1.0)
            length = s[10 + k]
            active = own * s[1] * max(1.0 - p[5] * length * length, 0.05)
            stretched = p[6] * length * abs(length)
            speed = (force - active - stretched) / (active + 0.15)
            s[10 + k] += c[STEP_S] / 6.0 * p[3] * min(max(speed, -1.0), 1.0)
    return p[0] * c[LARGEST_NM] * force


@mechanism(
    "phosphate and potassium of a closed space, washed out by flow that force itself stops; Dutka and Lamb 2004",
    "fatigue asymmetric_relaxation activation_dependent_speed",
    rise_s=(0.03, 0.1),
    force_s=(0.06, 0.3),
    heaps_s=(3.0, 15.0),
    washed_s=(5.0, 25.0),
    lost=(0.3, 0.9),
    block=(0.1, 1.2),
    stops=(0.3, 0.9),
    block_s=(0.5, 3.0),
)
def kept_b(x, p, s, c):
    """p: scale, activation s, force s, heaps up s, washed out s, force lost, block of weak pulses, flow, block s.

    s: activation, force, phosphate, potassium.
    """
    drive = x / c[LARGEST_NM]
    if c[PULSE] > 0.0:
        s[3] += (1.0 - s[3]) * min(0.025 / p[8], 1.0)
    s[3] *= math.exp(-c[STEP_S] / (4.0 * p[8]))
    drive = drive ** (1.0 + p[6] * s[3])
    s[0] = lag_after(drive, drive, s[0], p[1], c[STEP_S])
    flow = 1.0 / (1.0 + (s[1] / p[7]) ** 4)
    s[2] += c[STEP_S] * (s[1] * (1.0 - s[2]) / p[3] - flow * s[2] / p[4])
    target = s[0] * (1.0 - p[5] * s[2] * s[2])
    tau = p[2] * (1.0 + 1.5 * s[2]) * (1.0 - 0.5 * s[0])
    s[1] += (target - s[1]) * (1.0 - math.exp(-c[STEP_S] / tau))
    return p[0] * c[LARGEST_NM] * max(s[1], 0.0)


SEALED = {"kept_a": kept_a, "kept_b": kept_b}

"""Antagonist cross-talk: at large pulse widths current spreads to the antagonist, which pulls back, more slowly."""

from __future__ import annotations

import math

from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base, second_order_step
from stimrig.hardware_sim.patients.hidden.kernels import LARGEST_NM, STEP_S, WIDTH_US, Formulation, Stage, kernel


@kernel("additive")
def _pull_back(x, p, s, c):
    """p: largest pull as a share, threshold µs, rise µs, 1/Tω, ζ, fatigue s. s: pull and its speed, late copy."""
    w = c[WIDTH_US] - p[1]
    drive = 1.0 - math.exp(-w / p[2]) if w > 0.0 else 0.0
    tired = 1.0 / (1.0 + s[3])
    s[3] += c[STEP_S] * (drive * 0.8 - s[3] / p[5])
    return x - p[0] * c[LARGEST_NM] * second_order_step(drive * tired, p[3], p[4], s, 0, c[STEP_S])


def pull_back(rng: Generator, base: Base) -> Formulation:
    _, high = base.rise_us()
    threshold = min(high, base.largest_width_us * 0.8) * float(rng.uniform(0.7, 0.95))
    rise = float(rng.uniform(15.0, 60.0))
    rate = 1.0 / (base.t_omega_s * float(rng.uniform(2.0, 4.0)))
    tiring = float(rng.uniform(1.5, 5.0))
    return Formulation(
        "a slow, quickly tiring antagonist at large widths",
        "spill-over to the antagonist, as in Durfee and MacLean 1989",
        lambda m: [Stage(_pull_back, (m, threshold, rise, rate, 1.1, tiring))],
        1.5,
        "share",
        {"threshold_us": threshold, "rise_us": rise, "slower_by": 1.0 / (rate * base.t_omega_s), "tiring_s": tiring},
    )


FORMULATIONS = (pull_back,)

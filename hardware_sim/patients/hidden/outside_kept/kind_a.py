"""A stretch reflex of the splinted limb: a rise of torque is answered a moment later by a pull, one way only."""

from __future__ import annotations

from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base, second_order_step
from stimrig.hardware_sim.patients.hidden.kernels import LARGEST_NM, STEP_S, Formulation, Stage, kernel


@kernel("additive")
def _reflex(x, p, s, c):
    """p: torque per (largest torque a second), delay s, 1/Tω, threshold 1/s, sign. s: filter, x before, ring of 900."""
    size = 900
    rate = (x - s[2]) / (c[LARGEST_NM] * c[STEP_S])
    s[2] = x
    i = int(s[3])
    s[10 + i] = max(rate * p[4] - p[3], 0.0)
    s[3] = (i + 1) % size
    late = min(int(p[1] / c[STEP_S] + 0.5), size - 1)
    drive = s[10 + (i - late) % size]
    return x + p[0] * c[LARGEST_NM] * second_order_step(drive, p[2], 1.0, s, 0, c[STEP_S])


def reflex(rng: Generator, _base: Base) -> Formulation:
    delay, speed = float(rng.uniform(0.04, 0.12)), 1.0 / float(rng.uniform(0.03, 0.12))
    threshold, sign = float(rng.uniform(0.1, 0.4)), float(rng.choice([-1.0, 1.0]))
    pull = float(rng.choice([-1.0, 1.0], p=[0.6, 0.4]))
    return Formulation(
        "delayed reflex to a quick change of torque",
        "stretch reflex with threshold and delay, Kearney, Stein and Parameswaran 1997, transposed to torque",
        lambda m: [Stage(_reflex, (pull * m, delay, speed, threshold, sign))],
        0.6,
        "gain_s",
        {"delay_s": delay, "threshold_per_s": threshold, "answers": "rise" if sign > 0 else "fall", "pull": pull},
    )


FORMULATIONS = (reflex,)

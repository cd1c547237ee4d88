"""Slow fibres of a higher order."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base, second_order_step
from hardware_sim.patients.hidden.kernels import FORCE, LARGEST_NM, STEP_S, Formulation, Stage, kernel


@kernel
def _third_order(x, p, s, c):
    """p: 1/Tω, ζ, slow share, time constant of each of three lags s."""
    fast = second_order_step(x, p[0], p[1], s, 0, c[STEP_S])
    keep = math.exp(-c[STEP_S] / p[3])
    signal = x
    for i in range(3):
        s[2 + i] = signal + (s[2 + i] - signal) * keep
        signal = s[2 + i]
    y = (1.0 - p[2]) * fast + p[2] * signal
    c[FORCE] = y / c[LARGEST_NM]
    return y


def third_order(rng: Generator, base: Base) -> Formulation:
    lag = float(rng.uniform(1.0, 2.2)) * base.t_omega_s
    return Formulation(
        "slow fibres of third order",
        "sim",
        lambda m: [Stage("dynamics", _third_order, (1.0 / base.t_omega_s, base.zeta, m, lag))],
        0.8,
        "slow_share",
        {"lag_s": lag},
    )


FORMULATIONS = (third_order,)

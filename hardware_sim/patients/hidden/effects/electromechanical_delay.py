"""Electromechanical delay: torque answers some tens of milliseconds after the pulse."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import LARGEST_NM, STEP_S, Formulation, Stage, kernel


@kernel
def _line(x, p, s, c):
    """p: delay s. s[0]: place in the ring; a transport line with linear interpolation between samples."""
    size = 700
    i = int(s[0])
    s[1 + i] = x
    late = min(p[0] / c[STEP_S], 690.0)
    whole = int(late)
    part = late - whole
    a = s[1 + (i - whole) % size]
    b = s[1 + (i - whole - 1) % size]
    s[0] = (i + 1) % size
    return a + part * (b - a)


@kernel
def _lags(x, p, s, c):
    """p: delay s, number of lags (a gamma-shaped delay), each integrated in closed form."""
    if p[0] <= 0.0:
        return x
    n = int(p[1])
    keep = np.exp(-c[STEP_S] * n / p[0])
    for i in range(n):
        s[i] = x + (s[i] - x) * keep
        x = s[i]
    return x


@kernel
def _spread(x, p, s, c):
    """p[0:10]: delay of each tenth of the pool, in recruitment order, s. s[0]: place in the ring."""
    size = 700
    i = int(s[0])
    s[1 + i] = x / c[LARGEST_NM] * 10.0
    torque = 0.0
    for unit in range(10):
        late = min(p[unit] / c[STEP_S], 690.0)
        whole = int(late)
        part = late - whole
        a = min(max(s[1 + (i - whole) % size] - unit, 0.0), 1.0 if unit < 9 else 5.0)
        b = min(max(s[1 + (i - whole - 1) % size] - unit, 0.0), 1.0 if unit < 9 else 5.0)
        torque += a + part * (b - a)
    s[0] = (i + 1) % size
    return torque * c[LARGEST_NM] / 10.0


def transport_line(_rng: Generator, _base: Base) -> Formulation:
    return Formulation(
        "transport line", "Cavanagh and Komi 1979", lambda m: [Stage("delay", _line, (m,))], 0.12, "delay_s"
    )


def chain_of_lags(rng: Generator, _base: Base) -> Formulation:
    count = int(rng.integers(5, 13))
    return Formulation(
        "chain of equal lags",
        "linear chain trick, MacDonald 1978",
        lambda m: [Stage("delay", _lags, (m, count))],
        0.14,
        "delay_s",
        {"lags": count},
    )


def motor_units(rng: Generator, _base: Base) -> Formulation:
    shape = np.sort(rng.uniform(0.6, 1.4, 10))  # large fast axons, recruited first, conduct faster
    return Formulation(
        "each motor unit has its own delay",
        "conduction velocity by size, Fuglevand, Winter and Patla 1993; onset times of Sinclair et al.",
        lambda m: [Stage("delay", _spread, tuple(m * shape))],
        0.12,
        "mean_delay_s",
        {"earliest": float(shape[0]), "latest": float(shape[-1])},
    )


FORMULATIONS = (transport_line, chain_of_lags, motor_units)

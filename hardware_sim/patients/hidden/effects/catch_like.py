"""Catch-like property: the onset of a train yields more torque than its later pulses."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ACTIVATION, COUNT, PAUSE_S, STEP_S, Formulation, Stage, kernel


@kernel
def _first_pulses(x, p, s, c):
    """p: gain of the first pulse, pulses it lasts, recovery s."""
    rested = 1.0 - math.exp(-c[PAUSE_S] / p[2])
    return x * (1.0 + p[0] * rested * math.exp(-(max(c[COUNT], 1.0) - 1.0) / p[1]))


@kernel
def _store(x, p, s, c):
    """p: gain, refill s, emptying s. s[0]: what the store has lost. Calcium release from a store that runs down."""
    if c[ACTIVATION] > 0.0:
        s[0] += c[STEP_S] * c[ACTIVATION] * (1.0 - s[0]) / p[2]
    s[0] -= c[STEP_S] * s[0] / p[1]
    return x * (1.0 + p[0] * (1.0 - s[0]))


@kernel
def _burst(x, p, s, c):
    """p: gain, time of its peak s, pause it needs s. s: age of the train, age of the pause, readiness.

    An alpha function from the moment the muscle is engaged again.
    """
    if c[ACTIVATION] > 0.03:
        if s[1] > 0.0:
            s[2] = 1.0 - math.exp(-s[1] / p[2]) if s[3] > 0.0 else 1.0
            s[0] = 0.0
            s[1] = 0.0
            s[3] = 1.0
        s[0] += c[STEP_S]
    else:
        s[1] += c[STEP_S]
    z = s[0] / p[1]
    return x * (1.0 + p[0] * s[2] * (z + 0.3) * math.exp(-z))


def first_pulses(rng: Generator, _base: Base) -> Formulation:
    lasts, recovery = float(rng.uniform(3.0, 12.0)), float(rng.uniform(0.1, 0.6))
    return Formulation(
        "gain of the first pulses",
        "Binder-Macleod and Kesar 2005; Bickel, Slade and Dudley 2004",
        lambda m: [Stage("gain", _first_pulses, (m, lasts, recovery))],
        2.5,
        "first_gain",
        {"lasts_pulses": lasts, "recovery_s": recovery},
    )


def store(rng: Generator, _base: Base) -> Formulation:
    refill, empty = float(rng.uniform(0.3, 1.2)), float(rng.uniform(0.1, 0.3))
    return Formulation(
        "calcium store that runs down",
        "store depletion as in Tsodyks and Markram 1997, for calcium release after Duchateau and Hainaut 1986",
        lambda m: [Stage("gain", _store, (m, refill, empty))],
        4.0,
        "gain",
        {"refill_s": refill, "empty_s": empty},
    )


def burst(rng: Generator, _base: Base) -> Formulation:
    peak, pause = float(rng.uniform(0.06, 0.2)), float(rng.uniform(0.08, 0.5))
    return Formulation(
        "burst at the onset of a train",
        "stiffness of the series elastic element, Parmiggiani and Stein 1981",
        lambda m: [Stage("gain", _burst, (m, peak, pause))],
        3.0,
        "gain",
        {"peak_s": peak, "pause_s": pause},
    )


FORMULATIONS = (first_pulses, store, burst)

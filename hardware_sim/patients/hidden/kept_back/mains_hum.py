"""Mains hum of a machine that switches."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import STEP_S, TIME_S, Formulation, Stage, kernel


@kernel
def _switching(x, p, s, c):
    """p: size, mains Hz, period and share of the machine's work s, third harmonic. s[0]: present size."""
    at = (c[TIME_S] / p[2]) % 1.0
    s[0] += c[STEP_S] / 0.1 * ((1.0 if at < p[3] else 0.35) - s[0])
    turn = 2.0 * math.pi * p[1] * c[TIME_S]
    return x + p[0] * s[0] * (math.sin(turn) + p[4] * math.sin(3.0 * turn + 1.0))


def switching(rng: Generator, _base: Base) -> Formulation:
    mains = float(rng.choice([50.0, 60.0]))
    numbers = float(rng.uniform(8.0, 25.0)), float(rng.uniform(0.4, 0.8)), float(rng.uniform(0.0, 0.5))
    return Formulation(
        "a machine switches on and off",
        "compressor duty cycle",
        lambda m: [Stage("sensor", _switching, (m, mains, *numbers))],
        2.5,
        "amplitude_nm",
        {"mains_hz": mains, "period_s": numbers[0], "share_on": numbers[1]},
    )


FORMULATIONS = (switching,)

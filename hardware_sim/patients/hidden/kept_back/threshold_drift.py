"""Threshold drift with use."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import STEP_S, TIME_S, WIDTH_US, Formulation, Stage, kernel


@kernel
def _settling(x, p, s, c):
    """p: µs a decade of time, first time s. Charge transfer at the interface settles with the logarithm of time."""
    return max(x - p[0] * math.log10(1.0 + c[TIME_S] / p[1]), 0.0) if x > 0.0 else 0.0


@kernel
def _with_charge(x, p, s, c):
    """p: µs after a second of charge of 300 µs pulses. s[0]: charge so far. Polarisation that stays."""
    s[0] += c[STEP_S] * c[WIDTH_US] / 300.0
    return max(x - p[0] * s[0], 0.0) if x > 0.0 else 0.0


def settling(rng: Generator, _base: Base) -> Formulation:
    first, sign = float(rng.uniform(3.0, 12.0)), float(rng.choice([-1.0, 1.0]))
    return Formulation(
        "goes with the logarithm of time",
        "constant-phase settling of the electrode interface, McAdams and Jossinet 1995",
        lambda m: [Stage("electrode", _settling, (sign * m, first))],
        90.0,
        "us_per_decade",
        {"first_s": first, "sign": sign},
    )


def with_charge(rng: Generator, _base: Base) -> Formulation:
    sign = float(rng.choice([-1.0, 1.0]))
    return Formulation(
        "goes with the charge delivered",
        "electrode polarisation, Merrill, Bikson and Jefferys 2005",
        lambda m: [Stage("electrode", _with_charge, (sign * m,))],
        6.0,
        "us_per_s_of_charge",
        {"sign": sign},
    )


FORMULATIONS = (settling, with_charge)

"""Fatigue by metabolites."""

from __future__ import annotations

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ACTIVATION, STEP_S, Formulation, Stage, kernel


@kernel
def _phosphate(x, p, s, c):
    """p: production per s, clearance s, Hill exponent. s[0]: phosphate over the level that halves the force."""
    s[0] += c[STEP_S] * (p[0] * c[ACTIVATION] - s[0] / p[1])
    return x / (1.0 + s[0] ** p[2])


def phosphate(rng: Generator, _base: Base) -> Formulation:
    clearance, exponent = float(rng.uniform(25.0, 90.0)), float(rng.uniform(1.0, 2.2))
    return Formulation(
        "phosphate inhibits force",
        "inorganic phosphate, Allen, Lamb and Westerblad 2008",
        lambda m: [Stage("gain", _phosphate, (m, clearance, exponent))],
        0.5,
        "production_per_s",
        {"clearance_s": clearance, "exponent": exponent},
    )


FORMULATIONS = (phosphate,)

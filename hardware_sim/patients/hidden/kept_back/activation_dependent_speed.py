"""Speed by recruitment."""

from __future__ import annotations

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ACTIVATION, SPEED, Formulation, Stage, kernel


@kernel
def _by_recruitment(x, p, s, c):
    """p: size (signed), exponent. Rates go with how many units are being stimulated, not with their force."""
    a = min(max(c[ACTIVATION], 0.0), 1.2)
    c[SPEED] *= 1.0 + p[0] * a ** p[1] if p[0] > 0.0 else 1.0 / (1.0 - p[0] * a ** p[1])
    return x


def by_recruitment(rng: Generator, _base: Base) -> Formulation:
    sign, exponent = float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.6, 2.0))
    return Formulation(
        "rates go with the recruited share",
        "local models at several levels, Hunt, Munih, Donaldson and Barr 1998",
        lambda m: [Stage("delay", _by_recruitment, (sign * m, exponent))],
        4.0,
        "speed_gain",
        {"faster_when": "more recruited" if sign > 0 else "less recruited", "exponent": exponent},
    )


FORMULATIONS = (by_recruitment,)

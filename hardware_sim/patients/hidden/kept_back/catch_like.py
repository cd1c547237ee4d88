"""Catch-like property as priming."""

from __future__ import annotations

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ACTIVATION, STEP_S, Formulation, Stage, kernel


@kernel
def _primed(x, p, s, c):
    """p: gain, priming s, use s. s[0]: primed share; grows at rest, used up by activity in proportion to itself."""
    a = min(max(c[ACTIVATION], 0.0), 1.0)
    gain = 1.0 + p[0] * s[0] * s[0]
    s[0] += c[STEP_S] * ((1.0 - a) * (1.0 - s[0]) / p[1] - a * s[0] / p[2])
    return x * gain


def primed(rng: Generator, _base: Base) -> Formulation:
    priming, use = float(rng.uniform(0.1, 0.5)), float(rng.uniform(0.1, 0.3))
    return Formulation(
        "rest primes the next onset",
        "Lee, Gerdom and Binder-Macleod 1999, in one state",
        lambda m: [Stage("gain", _primed, (m, priming, use))],
        4.0,
        "gain",
        {"priming_s": priming, "use_s": use},
    )


FORMULATIONS = (primed,)

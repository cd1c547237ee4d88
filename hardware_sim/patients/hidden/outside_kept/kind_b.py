"""A stimulator that takes up a new setting only now and then: for some pulses the old width is still sent."""

from __future__ import annotations

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel, uniform


@kernel
def _stale(x, p, s, c):
    """p: mean time between settings s, spread. s: width in force, time of the next setting, generator."""
    if p[0] <= 0.0:
        return x
    if c[TIME_S] >= s[1]:
        s[0] = x
        s[1] += p[0] * (1.0 + p[1] * (2.0 * uniform(s, 2) - 1.0))
    return s[0]


def stale(rng: Generator, _base: Base) -> Formulation:
    spread, seed = float(rng.choice([0.0, 0.2, 0.8])), int(rng.integers(1, 2**31))
    return Formulation(
        "settings are taken up now and then",
        "a slow link between computer and stimulator",
        lambda m: [Stage("electrode", _stale, (m, spread), (0.0, 0.0, seed))],
        0.6,
        "mean_time_s",
        {"spread": spread},
    )


FORMULATIONS = (stale,)

"""Potentiation by work done."""

from __future__ import annotations

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import FORCE, STEP_S, Formulation, Stage, kernel


@kernel
def _by_work(x, p, s, c):
    """p: gain, build-up s, two decays s. s: two stores filled by force."""
    fill = c[STEP_S] * max(c[FORCE], 0.0) / p[1]
    s[0] += fill * (1.0 - s[0]) - c[STEP_S] * s[0] / p[2]
    s[1] += fill * (1.0 - s[1]) - c[STEP_S] * s[1] / p[3]
    return x * (1.0 + p[0] * (0.5 * s[0] + 0.5 * s[1]) ** 1.3)


def by_work(rng: Generator, _base: Base) -> Formulation:
    numbers = float(rng.uniform(2.5, 8.0)), float(rng.uniform(8.0, 20.0)), float(rng.uniform(40.0, 120.0))
    return Formulation(
        "two stores filled by force",
        "biexponential decay of potentiation, O'Leary, Hope and Sale 1997",
        lambda m: [Stage("gain", _by_work, (m, *numbers))],
        1.5,
        "gain",
        dict(zip(("build_up_s", "fast_decay_s", "slow_decay_s"), numbers, strict=True)),
    )


FORMULATIONS = (by_work,)

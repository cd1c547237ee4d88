"""History-dependent force: after a high torque some of it lingers (or is missing) at the next lower one."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ACTIVATION, STEP_S, Formulation, Stage, kernel


@kernel
def _residual(x, p, s, c):
    """p: share, decay s. s[0]: highest torque of this contraction, released only by full relaxation."""
    if c[ACTIVATION] < 0.02:
        s[1] += c[STEP_S]
        if s[1] > 0.4:
            s[0] *= math.exp(-c[STEP_S] / 0.05)
    else:
        s[1] = 0.0
    s[0] = max(s[0] * math.exp(-c[STEP_S] / p[1]), x)
    return x + p[0] * (s[0] - x) * (1.0 if c[ACTIVATION] > 0.02 else 0.0)


def residual(rng: Generator, _base: Base) -> Formulation:
    decay = float(rng.uniform(8.0, 40.0))
    sign = float(rng.choice([-1.0, 1.0]))
    return Formulation(
        "residual force enhancement or depression",
        "Abbott and Aubert 1952; Herzog 2004, transposed to activation",
        lambda m: [Stage("gain", _residual, (sign * m, decay))],
        0.95,
        "share",
        {"decay_s": decay, "sign": sign},
    )


FORMULATIONS = (residual,)

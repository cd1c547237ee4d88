"""Two compliances in series."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import STEP_S, Formulation, Stage, kernel


@kernel
def _chain(x, p, s, c):
    """p: 1/ω² s², ζ, second ω over first. s: two displacements and speeds.

    Muscle pulls the first mass against the second, the load cell holds the second: x -> m1 -> spring -> m2 -> cell.
    """
    if p[0] < 1e-8:
        return x
    omega = 1.0 / math.sqrt(p[0])
    second = omega * p[2]
    pieces = int(second * c[STEP_S] / 0.05) + 1
    h = c[STEP_S] / pieces
    for i in range(pieces):
        drive = s[4] + (x - s[4]) * (i + 0.5) / pieces
        first = s[0] - s[2] + 2.0 * p[1] / omega * (s[1] - s[3])
        s[1] += h * omega * omega * (drive - first)
        s[3] += h * second * second * (first - s[2] - 2.0 * p[1] / second * s[3])
        s[0] += h * s[1]
        s[2] += h * s[3]
    s[4] = x
    return s[2] + 2.0 * p[1] / second * s[3]


def chain(rng: Generator, _base: Base) -> Formulation:
    damping, ratio = float(rng.uniform(0.05, 0.25)), float(rng.uniform(2.0, 4.0))
    return Formulation(
        "two masses in a row",
        "forearm and splint, a mode each",
        lambda m: [Stage("structure", _chain, (m, damping, ratio))],
        0.02,
        "inverse_omega_squared_s2",
        {"zeta": damping, "second_over_first": ratio},
    )


FORMULATIONS = (chain,)

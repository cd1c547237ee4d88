"""Delay that depends on the pulse width: weak pulses answer later (or earlier) than strong ones."""

from __future__ import annotations

from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base
from stimrig.hardware_sim.patients.hidden.kernels import ACTIVATION, STEP_S, Formulation, Stage, kernel


@kernel("delay")
def _variable_line(x, p, s, c):
    """p: delay range s, sign. s[0]: place in the ring of 1000; each sample is put where it will come out."""
    size = 1000
    i = int(s[0])
    a = min(max(c[ACTIVATION], 0.0), 1.0)
    late = p[0] * (a if p[1] > 0.0 else 1.0 - a)
    ahead = min(int(late / c[STEP_S] + 0.5), 900)
    furthest = min(int(p[0] / c[STEP_S]) + 2, 950)
    for k in range(ahead, furthest + 1):
        s[1 + (i + k) % size] = x
    out = s[1 + i % size]
    s[0] = (i + 1) % size
    return out if p[0] > 0.0 else x


def variable_line(rng: Generator, _base: Base) -> Formulation:
    sign = float(rng.choice([-1.0, 1.0], p=[0.7, 0.3]))
    return Formulation(
        "transport line as long as the pulse is weak" if sign < 0 else "transport line as long as the pulse is strong",
        "conduction of small axons; made to be foreign",
        lambda m: [Stage(_variable_line, (m, sign))],
        0.25,
        "delay_range_s",
        {"late_when": "strong" if sign > 0 else "weak"},
    )


FORMULATIONS = (variable_line,)

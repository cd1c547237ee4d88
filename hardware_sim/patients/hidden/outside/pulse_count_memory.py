"""Memory of the number of pulses: the gain goes up and down with how many pulses there have been."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import COUNT, PULSE, Formulation, Stage, kernel


@kernel
def _all_pulses(x, p, s, c):
    """p: depth, pulses a turn. s[0]: pulses so far. A gain that swings with the pulses, not with time."""
    s[0] += c[PULSE]
    return x * (1.0 + p[0] * math.sin(2.0 * math.pi * s[0] / p[1]))


@kernel
def _every_other(x, p, s, c):
    """p: depth, pulses of a group. Alternans: groups of pulses of a train are strong and weak in turn."""
    group = int((max(c[COUNT], 1.0) - 1.0) / p[1])
    return x * (1.0 + (p[0] if group % 2 == 0 else -p[0]))


def swing(rng: Generator, _base: Base) -> Formulation:
    turn = float(rng.uniform(60.0, 160.0))
    return Formulation(
        "gain swings with the count of pulses",
        "no physiology; made to be foreign",
        lambda m: [Stage("gain", _all_pulses, (m, turn))],
        0.9,
        "depth",
        {"pulses_a_turn": turn},
    )


def alternans(rng: Generator, _base: Base) -> Formulation:
    group = int(rng.integers(6, 14))
    return Formulation(
        "groups of pulses strong and weak in turn",
        "mechanical alternans, transposed",
        lambda m: [Stage("gain", _every_other, (m, group))],
        0.9,
        "depth",
        {"pulses_a_group": group},
    )


FORMULATIONS = (swing, alternans)

"""Memory of the number of pulses: the gain goes up and down with how many pulses there have been."""

from __future__ import annotations

import math

from stimrig.hardware_sim.patients.hidden.kernels import COUNT, PULSE, kernel
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("gain")
def _all_pulses(x, p, s, c):
    """p: depth, pulses a turn. s[0]: pulses so far. A gain that swings with the pulses, not with time."""
    s[0] += c[PULSE]
    return x * (1.0 + p[0] * math.sin(2.0 * math.pi * s[0] / p[1]))


@kernel("gain")
def _every_other(x, p, s, c):
    """p: depth, pulses of a group. Alternans: groups of pulses of a train are strong and weak in turn."""
    group = int((max(c[COUNT], 1.0) - 1.0) / p[1])
    return x * (1.0 + (p[0] if group % 2 == 0 else -p[0]))


FORMULATIONS = (
    Written(
        "gain swings with the count of pulses",
        "no physiology; made to be foreign",
        _all_pulses,
        0.9,
        "depth",
        {"pulses_a_turn": (60.0, 160.0)},
    ),
    Written(
        "groups of pulses strong and weak in turn",
        "mechanical alternans, transposed",
        _every_other,
        0.9,
        "depth",
        {"pulses_a_group": lambda rng, _base: int(rng.integers(6, 14))},
    ),
)

"""An amplifier that seeks its own zero: the zero follows what is read, always or while little is read."""

from __future__ import annotations

from stimrig.hardware_sim.patients.hidden.kernels import LARGEST_NM, STEP_S, kernel
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("sensor")
def _coupled(x, p, s, c):
    """p: rate 1/s. s[0]: zero. Coupled through a capacitor."""
    out = x - s[0]
    s[0] += p[0] * c[STEP_S] * out
    return out


@kernel("sensor")
def _tracking(x, p, s, c):
    """p: rate 1/s, window as a share. s[0]: zero. It follows only what lies within the window."""
    out = x - s[0]
    window = p[1] * c[LARGEST_NM]
    if abs(out) < window:
        s[0] += p[0] * c[STEP_S] * out
    return out


FORMULATIONS = (
    Written(
        "the zero follows the reading",
        "high-pass coupling of a bridge amplifier",
        _coupled,
        1.0,
        "rate_per_s",
    ),
    Written(
        "the zero follows small readings",
        "zero tracking of weighing indicators",
        _tracking,
        4.0,
        "rate_per_s",
        {"window_share": (0.2, 0.6)},
    ),
)

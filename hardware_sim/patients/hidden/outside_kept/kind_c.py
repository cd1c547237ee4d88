"""A stimulator with a soft start: its pulse width rises (or also falls) only so quickly, whatever is asked."""

from __future__ import annotations

from stimrig.hardware_sim.patients.hidden.kernels import STEP_S, kernel
from stimrig.hardware_sim.patients.hidden.written import Written, largest_width_us


@kernel("electrode")
def _slewed(x, p, s, c):
    """p: s for the largest width up and down as a share of it, largest width µs. s[0]: width in force."""
    up = p[2] * c[STEP_S] / max(p[0], 1e-9)
    down = p[2] * c[STEP_S] / max(p[0] * p[1], 1e-9)
    s[0] += min(max(x - s[0], -down), up)
    return s[0]


FORMULATIONS = (
    Written(
        "the width is slewed",
        "soft start of clinical stimulators",
        _slewed,
        2.0,
        "up_s",
        {"down_share": [0.0, 0.5, 1.0], "_largest": largest_width_us},
    ),
)

"""History-dependent force: after a high torque some of it lingers (or is missing) at the next lower one."""

from __future__ import annotations

import math

from stimrig.hardware_sim.patients.hidden.kernels import ACTIVATION, STEP_S, kernel
from stimrig.hardware_sim.patients.hidden.written import Sign, Written


@kernel("gain")
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


FORMULATIONS = (
    Written(
        "residual force enhancement or depression",
        "Abbott and Aubert 1952; Herzog 2004, transposed to activation",
        _residual,
        0.95,
        "share",
        {"decay_s": (8.0, 40.0), "sign": Sign()},
    ),
)

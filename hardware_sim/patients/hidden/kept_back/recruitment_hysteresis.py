"""Hysteresis as a curve for each direction."""

from __future__ import annotations

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base, look_up
from hardware_sim.patients.hidden.kernels import ACTIVATION, LARGEST_NM, Formulation, Stage, kernel


@kernel
def _two_curves(x, p, s, c):
    """p[0:512]: torque at every µs; shift as a share of the width; reach µs. s: direction -1 to 1, width before."""
    s[0] = min(max(s[0] + (x - s[1]) / p[513], -1.0), 1.0)
    s[1] = x
    q = s[0] * (1.5 - 0.5 * s[0] * s[0])
    up, down = look_up(p, x * (1.0 - p[512])), look_up(p, x * (1.0 + p[512]))
    w = 0.5 * (1.0 + q) * up + 0.5 * (1.0 - q) * down
    c[ACTIVATION] = w / c[LARGEST_NM]
    return w


def two_curves(rng: Generator, base: Base) -> Formulation:
    reach = float(rng.uniform(20.0, 60.0))
    return Formulation(
        "a curve for rising and one for falling widths, blended",
        "two curves of ramp deconvolution, Durfee and MacLean 1989",
        lambda m: [Stage("recruitment", _two_curves, (*base.table_nm, m, reach))],
        0.25,
        "shift_share",
        {"reach_us": reach},
    )


FORMULATIONS = (two_curves,)

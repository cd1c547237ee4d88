"""Clipping with overload recovery."""

from __future__ import annotations

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import LARGEST_NM, TIME_S, Formulation, Stage, kernel


@kernel
def _overload(x, p, s, c):
    """p: share of the largest torque cut off, s the amplifier stays at the rail. s[0]: until when."""
    if p[0] <= 0.0:
        return x
    rail = (1.0 - p[0]) * c[LARGEST_NM]
    if x >= rail:
        s[0] = c[TIME_S] + p[1]
    return rail if c[TIME_S] <= s[0] and s[0] > 0.0 else x


def overload(rng: Generator, _base: Base) -> Formulation:
    stays = float(rng.uniform(0.005, 0.03))
    return Formulation(
        "the amplifier stays at its rail a little longer",
        "overload recovery",
        lambda m: [Stage("converter", _overload, (m, stays))],
        0.8,
        "share_cut_off",
        {"stays_s": stays},
    )


FORMULATIONS = (overload,)

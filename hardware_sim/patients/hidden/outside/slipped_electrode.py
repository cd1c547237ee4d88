"""A slipped electrode: at one moment it comes away from its place, and from then on everything is weaker or later."""

from __future__ import annotations

from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base
from stimrig.hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel
from stimrig.hardware_sim.patients.hidden.written import Sign, Written, weighted


@kernel("gain")
def _gain_step(x, p, s, c):
    """p: size with its sign, moment s."""
    return x * max(1.0 + p[0], 0.0) if c[TIME_S] >= p[1] else x


@kernel("electrode")
def _threshold_step(x, p, s, c):
    """p: size with its sign µs, moment s."""
    return max(x - p[0], 0.0) if x > 0.0 and c[TIME_S] >= p[1] else x


MOMENTS_S = ((5.0, 12.0), (14.7, 17.7), (19.0, 25.0))
"""Within the PRBS, between it and the ramp, within the ramp of a full test."""


def _moment(rng: Generator, _base: Base) -> float:
    return float(rng.uniform(*MOMENTS_S[int(rng.integers(len(MOMENTS_S)))]))


def both_step(rng: Generator, base: Base) -> Formulation:
    moment, us = _moment(rng, base), float(rng.uniform(30.0, 90.0))
    return Formulation(
        "gain and threshold step once",
        "electrode slip",
        lambda m: [Stage(_threshold_step, (m * us, moment)), Stage(_gain_step, (-m, moment))],
        0.7,
        "size",
        {"moment_s": moment, "us_per_size": us},
    )


FORMULATIONS = (
    Written(
        "the gain steps once",
        "electrode slip",
        _gain_step,
        0.7,
        "size",
        {"moment_s": _moment, "sign": Sign(weighted(0.7, 0.3))},
    ),
    Written(
        "the threshold steps once",
        "electrode slip",
        _threshold_step,
        90.0,
        "size_us",
        {"moment_s": _moment, "sign": Sign(weighted(0.3, 0.7))},
    ),
    both_step,
)

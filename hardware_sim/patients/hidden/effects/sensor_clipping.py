"""Sensor clipping: the load cell's amplifier or converter reaches its rail."""

from __future__ import annotations

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import LARGEST_NM, Formulation, Stage, kernel


@kernel
def _rail(x, p, s, c):
    """p: share of the largest torque that is cut off."""
    if p[0] <= 0.0:
        return x
    return min(x, (1.0 - p[0]) * c[LARGEST_NM])


@kernel
def _both_rails(x, p, s, c):
    """p: share cut off, lower rail as a share of the largest torque."""
    if p[0] <= 0.0:
        return x
    return max(min(x, (1.0 - p[0]) * c[LARGEST_NM]), -p[1] * c[LARGEST_NM])


@kernel
def _converter(x, p, s, c):
    """p: share cut off, counts up to the rail. A coarse-ish converter whose code stops at its end."""
    if p[0] <= 0.0:
        return x
    rail = (1.0 - p[0]) * c[LARGEST_NM]
    count = rail / p[1]
    return min(float(round(x / count)), p[1]) * count


def rail(_rng: Generator, _base: Base) -> Formulation:
    return Formulation("upper rail", "textbook", lambda m: [Stage("converter", _rail, (m,))], 0.8, "share_cut_off")


def both_rails(rng: Generator, _base: Base) -> Formulation:
    lower = float(rng.uniform(0.05, 0.3))
    return Formulation(
        "upper and lower rail",
        "textbook",
        lambda m: [Stage("converter", _both_rails, (m, lower))],
        0.8,
        "share_cut_off",
        {"lower_rail_share": lower},
    )


def converter(rng: Generator, _base: Base) -> Formulation:
    counts = int(rng.choice([2047, 4095, 8191]))
    return Formulation(
        "converter at its last code",
        "textbook",
        lambda m: [Stage("converter", _converter, (m, counts))],
        0.8,
        "share_cut_off",
        {"counts": counts},
    )


FORMULATIONS = (rail, both_rails, converter)

"""Potentiation: a muscle that has just worked gives more torque for the same recruitment."""

from __future__ import annotations

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import ACTIVATION, LARGEST_NM, PULSE, STEP_S, Formulation, Stage, kernel


@kernel
def _phosphorylation(x, p, s, c):
    """p: gain at full phosphorylation, rates of kinase and phosphatase per s. s[0]: phosphorylated share."""
    s[0] += c[STEP_S] * (p[1] * c[ACTIVATION] * (1.0 - s[0]) - p[2] * s[0])
    return x * (1.0 + p[0] * s[0])


@kernel
def _staircase(x, p, s, c):
    """p: gain at the end, what a pulse adds of what is left, decay s. s[0]: height of the staircase."""
    if c[PULSE] > 0.0 and c[ACTIVATION] > 0.03:
        s[0] += p[1] * (1.0 - s[0])
    s[0] -= c[STEP_S] * s[0] / p[2]
    return x * (1.0 + p[0] * s[0])


@kernel
def _calcium_sensitivity(x, p, s, c):
    """p: shift of the force-calcium curve, rates per s. Much at low activation, nothing at full activation."""
    a = min(max(c[ACTIVATION], 0.0), 1.0)
    s[0] += c[STEP_S] * (p[1] * a * (1.0 - s[0]) - p[2] * s[0])
    shift = p[0] * s[0]
    share = x / c[LARGEST_NM]
    if share >= 1.0:
        return x
    return c[LARGEST_NM] * share * (1.0 + shift) / (1.0 + shift * share)


def phosphorylation(rng: Generator, _base: Base) -> Formulation:
    on, off = float(rng.uniform(0.06, 0.4)), 1.0 / float(rng.uniform(15.0, 80.0))
    return Formulation(
        "light-chain phosphorylation",
        "Sweeney, Bowman and Stull 1993; sizes of O'Leary, Hope and Sale 1997",
        lambda m: [Stage("gain", _phosphorylation, (m, on, off))],
        1.2,
        "full_gain",
        {"kinase_per_s": on, "phosphatase_per_s": off},
    )


def staircase(rng: Generator, _base: Base) -> Formulation:
    step, decay = float(rng.uniform(0.004, 0.02)), float(rng.uniform(10.0, 60.0))
    return Formulation(
        "staircase, pulse by pulse",
        "treppe, Bowditch 1871; MacIntosh 2010",
        lambda m: [Stage("gain", _staircase, (m, step, decay))],
        1.2,
        "full_gain",
        {"share_a_pulse": step, "decay_s": decay},
    )


def calcium_sensitivity(rng: Generator, _base: Base) -> Formulation:
    on, off = float(rng.uniform(0.08, 0.4)), 1.0 / float(rng.uniform(15.0, 80.0))
    return Formulation(
        "leftward shift of the force-calcium curve",
        "Persechini, Stull and Cooke 1985",
        lambda m: [Stage("gain", _calcium_sensitivity, (m, on, off))],
        15.0,
        "shift",
        {"kinase_per_s": on, "phosphatase_per_s": off},
    )


FORMULATIONS = (phosphorylation, staircase, calcium_sensitivity)

"""Tremor: a rhythm of 3 to 8 Hz that the stimulation does not drive."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import FORCE, STEP_S, Formulation, Stage, kernel, normal


@kernel
def _narrow_band(x, p, s, c):
    """p: sd N·m, centre Hz, bandwidth Hz. s: last two values, generator. A second-order autoregression."""
    r = math.exp(-math.pi * p[2] * c[STEP_S])
    a1 = 2.0 * r * math.cos(2.0 * math.pi * p[1] * c[STEP_S])
    a2 = r * r
    sd = math.sqrt((1.0 - a2) * ((1.0 + a2) ** 2 - a1 * a1) / (1.0 + a2))
    value = a1 * s[0] - a2 * s[1] + sd * normal(s, 2)
    s[1] = s[0]
    s[0] = value
    return x + p[0] * value


@kernel
def _wandering(x, p, s, c):
    """p: amplitude, centre Hz, spread Hz, second harmonic, with force. s: phase, detuning, log amplitude, generator.

    Frequency and amplitude wander by themselves; `with force` 1 makes it an action tremor.
    """
    h = c[STEP_S]
    s[1] += -h * s[1] / 1.5 + p[2] * math.sqrt(2.0 * h / 1.5) * normal(s, 3)
    s[2] += -h * s[2] / 2.5 + 0.35 * math.sqrt(2.0 * h / 2.5) * normal(s, 3)
    s[0] = (s[0] + 2.0 * math.pi * (p[1] + s[1]) * h) % (2.0 * math.pi)
    size = p[0] * math.exp(s[2]) * (1.0 - p[4] + p[4] * (0.15 + 1.5 * min(max(c[FORCE], 0.0), 1.0)))
    return x + size * (math.sin(s[0]) + p[3] * math.sin(2.0 * s[0] + 0.7))


def _generator(rng: Generator) -> int:
    return int(rng.integers(1, 2**31))


def narrow_band(rng: Generator, _base: Base) -> Formulation:
    centre, band, seed = float(rng.uniform(3.0, 8.0)), float(rng.uniform(0.15, 0.8)), _generator(rng)
    return Formulation(
        "narrow-band noise",
        "autoregressive tremor, Randall 1973",
        lambda m: [Stage("additive", _narrow_band, (m, centre, band), (0.0, 0.0, seed))],
        4.0,
        "sd_nm",
        {"centre_hz": centre, "bandwidth_hz": band},
    )


def _oscillator(rng: Generator, name: str, source: str, with_force: float) -> Formulation:
    centre, spread = float(rng.uniform(3.0, 8.0)), float(rng.uniform(0.05, 0.35))
    second, seed = float(rng.uniform(0.0, 0.3)), _generator(rng)
    return Formulation(
        name,
        source,
        lambda m: [Stage("additive", _wandering, (m, centre, spread, second, with_force), (0.0, 0.0, 0.0, seed))],
        4.0,
        "amplitude_nm",
        {"centre_hz": centre, "spread_hz": spread, "second_harmonic": second},
    )


def wandering(rng: Generator, _base: Base) -> Formulation:
    return _oscillator(rng, "oscillator whose frequency and size wander", "Gresty and Buckwell 1990", 0.0)


def with_action(rng: Generator, _base: Base) -> Formulation:
    return _oscillator(rng, "action tremor, grows with force", "McAuley and Marsden 2000", 1.0)


FORMULATIONS = (narrow_band, wandering, with_action)

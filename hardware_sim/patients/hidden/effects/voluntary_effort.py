"""Voluntary effort and spasm: torque that has nothing to do with the stimulation."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.kernels import TIME_S, Formulation, Stage, kernel

EVENTS = 60


@kernel
def _bumps(x, p, s, c):
    """p: size N·m, then for each event: start s, length s, height, skewness. Raised cosines."""
    for i in range(60):
        start = p[1 + 4 * i]
        if c[TIME_S] < start:
            break
        part = (c[TIME_S] - start) / p[2 + 4 * i]
        if part < 1.0:
            x += p[0] * p[3 + 4 * i] * 0.5 * (1.0 - math.cos(2.0 * math.pi * part ** p[4 + 4 * i]))
    return x


@kernel
def _ramps(x, p, s, c):
    """p: size, then for each event: start, length, height, share of it spent rising (and falling). Smooth ramps."""
    for i in range(60):
        start = p[1 + 4 * i]
        if c[TIME_S] < start:
            break
        length = p[2 + 4 * i]
        left, right = c[TIME_S] - start, start + length - c[TIME_S]
        if right > 0.0:
            edge = p[4 + 4 * i] * length
            q = min(left, right, edge) / edge
            x += p[0] * p[3 + 4 * i] * q * q * (3.0 - 2.0 * q)
    return x


@kernel
def _spasms(x, p, s, c):
    """p: size, then for each event: start, decay s, height, rise s. Quick rise, exponential release."""
    for i in range(60):
        age = c[TIME_S] - p[1 + 4 * i]
        if age < 0.0:
            break
        decay, rise = p[2 + 4 * i], p[4 + 4 * i]
        if age < 12.0 * decay:
            x += p[0] * p[3 + 4 * i] * (math.exp(-age / decay) - math.exp(-age / rise)) * 1.3
    return x


def _events(rng: Generator, between_s: tuple[float, float]) -> np.ndarray:
    gaps = rng.uniform(*between_s, EVENTS)
    return float(rng.uniform(0.0, 5.0)) + np.cumsum(gaps) - gaps[0] * float(rng.uniform(0.0, 0.8))


def _formulation(rng: Generator, name: str, source: str, stage: object, table: np.ndarray, top: float) -> Formulation:
    if rng.random() < 0.15:  # the antagonist's
        table[:, 2] *= -1.0
    return Formulation(
        name,
        source,
        lambda m: [Stage("additive", stage, (m, *table.ravel()))],
        top,
        "typical_height_nm",
        {"first_events_s": table[:6, 0].tolist(), "first_heights": table[:6, 2].tolist()},
    )


def bumps(rng: Generator, _base: Base) -> Formulation:
    table = np.column_stack(
        [
            _events(rng, (7.0, 16.0)),
            rng.uniform(0.6, 2.5, EVENTS),
            rng.uniform(0.5, 1.5, EVENTS),
            np.exp(rng.normal(0.0, 0.25, EVENTS)),
        ]
    )
    return _formulation(rng, "smooth bumps", "bell-shaped efforts, Flash and Hogan 1985", _bumps, table, 12.0)


def ramps(rng: Generator, _base: Base) -> Formulation:
    table = np.column_stack(
        [
            _events(rng, (9.0, 20.0)),
            rng.uniform(1.5, 5.0, EVENTS),
            rng.uniform(0.5, 1.5, EVENTS),
            rng.uniform(0.15, 0.45, EVENTS),
        ]
    )
    return _formulation(rng, "held efforts with ramps", "no law", _ramps, table, 12.0)


def spasms(rng: Generator, _base: Base) -> Formulation:
    table = np.column_stack(
        [
            _events(rng, (8.0, 18.0)),
            rng.uniform(0.4, 1.8, EVENTS),
            rng.uniform(0.5, 1.5, EVENTS),
            rng.uniform(0.04, 0.12, EVENTS),
        ]
    )
    return _formulation(rng, "spasms that burst and decay", "no law", _spasms, table, 12.0)


FORMULATIONS = (bumps, ramps, spasms)

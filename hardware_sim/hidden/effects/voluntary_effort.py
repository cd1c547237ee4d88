"""Voluntary effort and spasm: torque that has nothing to do with the stimulation."""

from __future__ import annotations

import math

import numpy as np

from stimrig.hardware_sim.hidden.forms import Effect, Numbers, draws
from stimrig.hardware_sim.hidden.kernels import STEP_S, TIME_S, helper, normal

EFFECT = Effect("all")
EVENTS = 60


def _efforts(between_s, lengths_s, shapes):
    def draw(rng, _base):
        gaps = rng.uniform(*between_s, EVENTS)
        starts_s = float(rng.uniform(0.0, 5.0)) + np.cumsum(gaps) - gaps[0] * float(rng.uniform(0.0, 0.8))
        lasts_s = rng.uniform(*lengths_s, EVENTS)
        table = np.column_stack([starts_s, lasts_s, rng.uniform(0.5, 1.5, EVENTS), shapes(rng)])
        if rng.random() < 0.15:  # the antagonist's
            table[:, 2] *= -1.0
        return Numbers(table.ravel(), first_events_s=table[:6, 0].tolist(), first_heights=table[:6, 2].tolist())

    return draw


@helper
def _begun(p, c):
    """How many events have begun; the start of each is at p[1], p[5], …"""
    count = 0
    while count < EVENTS and c[TIME_S] >= p[1 + 4 * count]:
        count += 1
    return count


@EFFECT.form("smooth bumps", "bell-shaped efforts, Flash and Hogan 1985")
@draws(
    "additive",
    12.0,
    "typical_height_nm",
    _efforts=_efforts((7.0, 16.0), (0.6, 2.5), lambda rng: np.exp(rng.normal(0.0, 0.25, EVENTS))),
)
def _bumps(x, p, s, c):
    """p: size N·m, then for each event: start s, length s, height, skewness. Raised cosines."""
    for i in range(_begun(p, c)):
        part = (c[TIME_S] - p[1 + 4 * i]) / p[2 + 4 * i]
        if part < 1.0:
            x += p[0] * p[3 + 4 * i] * 0.5 * (1.0 - math.cos(2.0 * math.pi * part ** p[4 + 4 * i]))
    return x


@EFFECT.form("held efforts with ramps", "no law")
@draws(
    "additive",
    12.0,
    "typical_height_nm",
    _efforts=_efforts((9.0, 20.0), (1.5, 5.0), lambda rng: rng.uniform(0.15, 0.45, EVENTS)),
)
def _ramps(x, p, s, c):
    """p: size, then for each event: start, length, height, share of it spent rising (and falling). Smooth ramps."""
    for i in range(_begun(p, c)):
        start, length = p[1 + 4 * i], p[2 + 4 * i]
        since_start, until_end = c[TIME_S] - start, start + length - c[TIME_S]
        if until_end > 0.0:
            edge = p[4 + 4 * i] * length
            q = min(since_start, until_end, edge) / edge
            x += p[0] * p[3 + 4 * i] * q * q * (3.0 - 2.0 * q)
    return x


@EFFECT.form("spasms that burst and decay", "no law")
@draws(
    "additive",
    12.0,
    "typical_height_nm",
    _efforts=_efforts((8.0, 18.0), (0.4, 1.8), lambda rng: rng.uniform(0.04, 0.12, EVENTS)),
)
def _spasms(x, p, s, c):
    """p: size, then for each event: start, decay s, height, rise s. Quick rise, exponential release."""
    for i in range(_begun(p, c)):
        age = c[TIME_S] - p[1 + 4 * i]
        decay, rise = p[2 + 4 * i], p[4 + 4 * i]
        if age < 12.0 * decay:
            x += p[0] * p[3 + 4 * i] * (math.exp(-age / decay) - math.exp(-age / rise)) * 1.3
    return x


@EFFECT.held_back("effort whenever a slow random drive is high", "no law")
@draws("additive", 20.0, "size_nm", seed_at=3, correlation_s=(1.5, 4.0), threshold=(0.6, 1.2))
def _moods(x, p, s, c):
    """p: size N·m, correlation s, threshold. s: two lags of noise, generator. Effort where the process is high."""
    h = c[STEP_S]
    s[0] += -h * s[0] / p[1] + math.sqrt(2.0 * h / p[1]) * normal(s, 3)
    s[1] += h * (s[0] - s[1]) / 0.25
    drive = max(s[1] - p[2], 0.0)
    s[2] += h * (drive - s[2]) / 0.15
    return x + p[0] * s[2]

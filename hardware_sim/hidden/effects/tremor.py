"""Tremor: a rhythm of 3 to 8 Hz that the stimulation does not drive."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stimrig.hardware_sim.hidden.forms import Effect, Numbers, draws
from stimrig.hardware_sim.hidden.kernels import FORCE, STEP_S, TIME_S, normal

EFFECT = Effect("all")
OSCILLATOR: dict[str, Any] = {"centre_hz": (3.0, 8.0), "spread_hz": (0.05, 0.35), "second_harmonic": (0.0, 0.3)}


@EFFECT.form("narrow-band noise", "autoregressive tremor, Randall 1973")
@draws("additive", 4.0, "sd_nm", seed_at=2, centre_hz=(3.0, 8.0), bandwidth_hz=(0.15, 0.8))
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


@EFFECT.form("oscillator whose frequency and size wander", "Gresty and Buckwell 1990")
@draws("additive", 4.0, "amplitude_nm", seed_at=3, **OSCILLATOR, _with_force=0.0)
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


EFFECT.form("action tremor, grows with force", "McAuley and Marsden 2000", **OSCILLATOR, _with_force=1.0)(_wandering)


def _lines(rng, _base):
    centre = float(rng.uniform(3.4, 7.5))
    lines = np.column_stack([centre + rng.uniform(-0.35, 0.35, 3), rng.uniform(0.0, 2.0 * np.pi, 3)])
    return Numbers(lines.ravel(), lines_hz=lines[:, 0].tolist())


@EFFECT.held_back("three close lines", "beating motor units, Elble and Koller 1990")
@draws("additive", 3.0, "amplitude_nm", _lines=_lines)
def _beats(x, p, s, c):
    """p: size, then three pairs of Hz and phase. Close lines that beat, as of a few motor units."""
    for i in range(3):
        x += p[0] * math.sin(2.0 * math.pi * p[1 + 2 * i] * c[TIME_S] + p[2 + 2 * i])
    return x

"""Mains hum: 50 or 60 Hz and harmonics on the load cell's line."""

from __future__ import annotations

import math

import numpy as np

from stimrig.hardware_sim.hidden.forms import Effect, Numbers, draws
from stimrig.hardware_sim.hidden.kernels import STEP_S, TIME_S, normal

EFFECT = Effect("added")


def _mains(rng, _base):
    return float(rng.choice([50.0, 60.0]) + rng.normal(0.0, 0.01))


def _amplitudes(rng, _base):
    amplitude = np.array([1.0, 0.1, 0.4, 0.05, 0.2]) * rng.uniform(0.3, 1.2, 5)
    parts = np.column_stack([amplitude, rng.uniform(0.0, 2.0 * np.pi, 5)]).ravel()
    return Numbers(parts, harmonics=amplitude.tolist())


@EFFECT.form("fundamental and harmonics", "textbook")
@draws(
    "sensor",
    2.0,
    "amplitude_nm",
    mains_hz=_mains,
    _harmonics=_amplitudes,
    _depth=(0.0, 0.3),
    _slow_hz=(0.02, 0.2),
)
def _harmonics(x, p, s, c):
    """p: size, mains Hz, amplitude and phase of five harmonics, then depth and Hz of a slow change of size."""
    turn = 2.0 * math.pi * p[1] * c[TIME_S]
    size = p[0] * (1.0 + p[12] * math.sin(2.0 * math.pi * p[13] * c[TIME_S]))
    for i in range(5):
        x += size * p[2 + 2 * i] * math.sin((i + 1) * turn + p[3 + 2 * i])
    return x


@EFFECT.form("flattened sine with current peaks", "capacitor-input rectifiers")
@draws("sensor", 2.0, "amplitude_nm", mains_hz=_mains, _phase=(0.0, 2.0 * np.pi), share_flattened=(0.2, 0.8))
def _rectifier(x, p, s, c):
    """p: size, mains Hz, phase, share of the flattened sine; the rest are a rectifier's current peaks."""
    wave = math.sin(2.0 * math.pi * p[1] * c[TIME_S] + p[2])
    peaks = wave**5
    return x + p[0] * (p[3] * 1.2 * math.tanh(1.6 * wave) + (1.0 - p[3]) * 1.5 * peaks)


@EFFECT.form("the grid's frequency wanders", "grid frequency as an Ornstein-Uhlenbeck process")
@draws("sensor", 2.0, "amplitude_nm", seed_at=2, mains_hz=_mains, spread_hz=(0.005, 0.03), _tau_s=(3.0, 20.0))
def _wandering(x, p, s, c):
    """p: size, mains Hz, spread of the grid's frequency Hz, its time constant s. s: phase, detuning, generator."""
    s[1] += -c[STEP_S] * s[1] / p[3] + p[2] * math.sqrt(2.0 * c[STEP_S] / p[3]) * normal(s, 2)
    s[0] = (s[0] + 2.0 * math.pi * (p[1] + s[1]) * c[STEP_S]) % (2.0 * math.pi)
    return x + p[0] * (math.sin(s[0]) + 0.3 * math.sin(3.0 * s[0]))


@EFFECT.held_back("a machine switches on and off", "compressor duty cycle")
@draws(
    "sensor", 2.5, "amplitude_nm", mains_hz=[50.0, 60.0], period_s=(8.0, 25.0), share_on=(0.4, 0.8), _third=(0.0, 0.5)
)
def _switching(x, p, s, c):
    """p: size, mains Hz, period and share of the machine's work s, third harmonic. s[0]: present size."""
    at = (c[TIME_S] / p[2]) % 1.0
    s[0] += c[STEP_S] / 0.1 * ((1.0 if at < p[3] else 0.35) - s[0])
    turn = 2.0 * math.pi * p[1] * c[TIME_S]
    return x + p[0] * s[0] * (math.sin(turn) + p[4] * math.sin(3.0 * turn + 1.0))

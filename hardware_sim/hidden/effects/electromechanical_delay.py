"""Electromechanical delay: torque answers some tens of milliseconds after the pulse."""

from __future__ import annotations

import math

import numpy as np

from stimrig.hardware_sim.hidden.base import delayed
from stimrig.hardware_sim.hidden.forms import Effect, Numbers, draws
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, STEP_S

EFFECT = Effect()


@EFFECT.form("transport line", "Cavanagh and Komi 1979")
@draws("delay", 0.12, "delay_s")
def _line(x, p, s, c):
    """p: delay s. s[0]: place in the ring; a transport line with linear interpolation between samples."""
    return delayed(x, min(p[0] / c[STEP_S], 690.0), s, 1, 700)


@EFFECT.form("chain of equal lags", "linear chain trick, MacDonald 1978")
@draws("delay", 0.14, "delay_s", lags=lambda rng, _base: int(rng.integers(5, 13)))
def _lags(x, p, s, c):
    """p: delay s, number of lags (a gamma-shaped delay), each integrated in closed form."""
    n = int(p[1])
    decay = np.exp(-c[STEP_S] * n / p[0])
    for i in range(n):
        s[i] = x + (s[i] - x) * decay
        x = s[i]
    return x


def _delays(rng, _base):
    shape = np.sort(rng.uniform(0.6, 1.4, 10))  # large fast axons, recruited first, conduct faster
    return Numbers(shape, earliest=float(shape[0]), latest=float(shape[-1]))


@EFFECT.form(
    "each motor unit has its own delay",
    "conduction velocity by size, Fuglevand, Winter and Patla 1993; onset times of Sinclair et al.",
)
@draws("delay", 0.12, "mean_delay_s", arrange=lambda m, *shape: [m * each for each in shape], _delays=_delays)
def _spread(x, p, s, c):
    """p[0:10]: delay of each tenth of the pool, in recruitment order, s. s[0]: place in the ring."""
    size = 700
    i = int(s[0])
    s[1 + i] = x / c[LARGEST_NM] * 10.0
    torque = 0.0
    for unit in range(10):
        late = min(p[unit] / c[STEP_S], 690.0)
        whole = int(late)
        part = late - whole
        a = min(max(s[1 + (i - whole) % size] - unit, 0.0), 1.0 if unit < 9 else 5.0)
        b = min(max(s[1 + (i - whole - 1) % size] - unit, 0.0), 1.0 if unit < 9 else 5.0)
        torque += a + part * (b - a)
    s[0] = (i + 1) % size
    return torque * c[LARGEST_NM] / 10.0


@EFFECT.held_back(
    "conduction, then a lag of the series elastic element", "parts of the electromechanical delay, Nordez et al. 2009"
)
@draws("delay", 0.13, "delay_s", lag_share=(0.15, 0.45))
def _onset(x, p, s, c):
    """p: delay s, share of it that is a lag. s[0]: place in the ring, s[1]: the lag's state."""
    x = delayed(x, min(p[0] * (1.0 - p[1]) / c[STEP_S], 690.0), s, 10, 700)
    s[1] += (x - s[1]) * (1.0 - math.exp(-c[STEP_S] / (p[0] * p[1])))
    return s[1]

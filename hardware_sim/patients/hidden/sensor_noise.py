"""Measurement noise of an offline record."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator
from scipy.signal import lfilter

from stimrig.hardware_sim.patients.hidden.kernels import Floats

NOISES = ("white", "ar1", "slow")
SLOW_CORRELATION_S = 0.075


def _ar1(rng: Generator, count: int, sd_nm: float, rho: float) -> Floats:
    innovations = rng.normal(0.0, sd_nm * math.sqrt(1.0 - rho * rho), count)
    innovations[0] = rng.normal(0.0, sd_nm)
    return np.asarray(lfilter([1.0], [1.0, -rho], innovations))


def draw_noise(
    kind: str, rng: Generator, count: int, rate_hz: float, sd_nm: float, rho_40hz: float, slow_sd_nm: float
) -> Floats:
    """Sensor noise at the record's rate, N·m, shape (count,).

    `white`; `ar1`: first-order, with autocorrelation `rho_40hz` over 25 ms and standard deviation `sd_nm`; `slow`: the
    white noise and beside it noise of `slow_sd_nm` with a correlation time of 75 ms.

    Raises
    ------
    ValueError
        No such kind.
    """
    if kind == "white":
        return rng.normal(0.0, sd_nm, count)
    if kind == "ar1":
        return _ar1(rng, count, sd_nm, rho_40hz ** (40.0 / rate_hz))
    if kind == "slow":
        slow = _ar1(rng, count, slow_sd_nm, math.exp(-1.0 / (rate_hz * SLOW_CORRELATION_S)))
        return rng.normal(0.0, sd_nm, count) + slow
    raise ValueError(f"noise {kind!r}: one of {', '.join(NOISES)}")

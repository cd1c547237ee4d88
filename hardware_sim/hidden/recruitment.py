"""Shapes of the isometric recruitment curve, each with a drawn threshold and steepness.

Sources: the paper's sigmoid, eq. 35; Ding, Chou, Kesar et al. 2007 (exponential above a threshold); Hill and
Gompertz curves as used for dose and response; Durfee and MacLean 1989 (dead band, rise, plateau); a pool of motor
units with normally spread thresholds and log-normal sizes, as in Fuglevand, Winter and Patla 1993.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from scipy.interpolate import PchipInterpolator
from scipy.special import ndtr

from stimrig.hardware_sim.hidden.kernels import Floats


def _paper_sigmoid(u: Floats, middle: float, rise: float, _rng: Generator) -> Floats:
    a2 = 4.394 / rise
    e = np.exp(np.minimum(a2 * u, 600.0))
    return (e - 1.0) / (e + np.exp(a2 * middle))


def _ding(u: Floats, middle: float, rise: float, _rng: Generator) -> Floats:
    scale = rise / 2.197
    threshold = max(20.0, middle - 0.69 * scale)
    return np.where(u > threshold, 1.0 - np.exp(-(u - threshold) / scale), 0.0)


def _hill(u: Floats, middle: float, rise: float, rng: Generator) -> Floats:
    dead = middle * float(rng.uniform(0.2, 0.6))
    half = middle - dead
    # the 10-90 % width of a Hill curve is half (9^(1/n) - 9^(-1/n)): solve for n
    n = np.log(9.0) / np.arcsinh(rise / (2.0 * half))
    v = np.maximum(u - dead, 0.0) / half
    return v**n / (1.0 + v**n)


def _gompertz(u: Floats, middle: float, rise: float, _rng: Generator) -> Floats:
    c = 3.084 / rise
    g = np.exp(-np.log(2.0) * np.exp(-c * (u - middle)))
    return np.maximum(g - g[0], 0.0)


def _logistic_with_dead_band(u: Floats, middle: float, rise: float, rng: Generator) -> Floats:
    k = 4.394 / rise
    dead = middle - float(rng.uniform(0.45, 0.7)) * rise
    raw = 1.0 / (1.0 + np.exp(-np.clip(k * (u - middle), -500, 500)))
    return np.maximum(raw - 1.0 / (1.0 + np.exp(-k * (dead - middle))), 0.0) * (u > 0)


def _motor_units(u: Floats, middle: float, rise: float, rng: Generator) -> Floats:
    count = int(rng.integers(50, 201))
    threshold = rng.normal(middle, rise / 2.563, count)
    size = np.exp(rng.normal(0.0, 0.8, count))
    blur = float(rng.uniform(0.6, 2.0))  # an axon's threshold fluctuates by about 1 %
    pool = ndtr((u[:, None] - np.maximum(threshold, 8.0)) / blur) @ size
    return np.maximum(pool - pool[0], 0.0)


def _two_branches(u: Floats, middle: float, rise: float, rng: Generator) -> Floats:
    share = float(rng.uniform(0.35, 0.65))
    apart = 0.45 * rise
    first = ndtr((u - middle + apart) / (0.16 * rise))
    second = ndtr((u - middle - apart) / (0.2 * rise))
    both = share * first + (1.0 - share) * second
    return np.maximum(both - both[0], 0.0)


def _through_knots(u: Floats, middle: float, rise: float, rng: Generator) -> Floats:
    steps = rng.dirichlet(np.full(6, 3.0))
    start = max(15.0, middle - 0.6 * rise)
    knots = np.concatenate([[0.0, start], start + np.cumsum(np.full(6, rise * 1.2 / 6)), [620.0]])
    values = np.concatenate([[0.0, 0.0], np.cumsum(steps), [1.0 + float(rng.uniform(0.0, 0.1))]])
    return np.asarray(PchipInterpolator(knots, values)(u))


SHAPES = {
    "the paper's sigmoid": _paper_sigmoid,
    "exponential above a threshold": _ding,
    "Hill": _hill,
    "Gompertz": _gompertz,
    "logistic with dead band": _logistic_with_dead_band,
    "motor-unit pool": _motor_units,
    "two branches": _two_branches,
    "monotone curve through knots": _through_knots,
}


def draw(rng: Generator, steep: bool, size: int) -> tuple[str, Floats, dict[str, float], int]:
    """A shape's name, its values at 0 … size - 1 µs, its parameters, and the largest pulse width to send."""
    name = str(rng.choice(list(SHAPES)))
    largest = int(rng.choice([250, 300, 300, 300, 350, 400]))
    bounds = (5.0, 25.0) if steep else (26.0, 150.0)
    rise = float(np.exp(rng.uniform(*np.log(bounds))))
    low = max(45.0, 0.55 * rise)
    middle = float(rng.uniform(low, max(low + 5.0, largest - 0.75 * rise - 15.0)))
    u = np.arange(size, dtype=np.float64)
    share = SHAPES[name](u, middle, rise, rng)
    share[0] = 0.0
    return name, share, {"middle_us": round(middle, 3), "nominal_rise_us": round(rise, 3)}, largest

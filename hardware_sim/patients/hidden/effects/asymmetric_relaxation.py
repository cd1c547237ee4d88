"""Asymmetric relaxation: torque develops and decays at different speeds."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base, lag_after, second_order_step
from hardware_sim.patients.hidden.kernels import FORCE, LARGEST_NM, STEP_S, Formulation, Stage, kernel, random_sign


@kernel
def _thelen(x, p, s, c):
    """p: τ1, τ2, ratio, exponent of (0.5 + 1.5 a). s: activation, torque. Activation first, then a lag."""
    a = min(max(s[0], 0.0), 1.2)
    e = x / c[LARGEST_NM]
    factor = (0.5 + 1.5 * a) ** p[3]
    tau = p[0] / math.sqrt(p[2]) * factor if e > a else p[0] * math.sqrt(p[2]) / factor
    before = s[0]
    s[0] += (e - s[0]) * (1.0 - math.exp(-c[STEP_S] / tau))
    s[1] = lag_after(before * c[LARGEST_NM], s[0] * c[LARGEST_NM], s[1], p[1], c[STEP_S])
    c[FORCE] = s[1] / c[LARGEST_NM]
    return s[1]


@kernel
def _de_groote(x, p, s, c):
    """p: τ1, τ2, log ratio, b, share of the activation factor. Smooth change between the two time constants."""
    e = x / c[LARGEST_NM]
    a = s[0]
    f = 0.5 * math.tanh(p[3] * (e - a))
    factor = 1.0 + p[4] * (max(a, 0.0) - 0.4)
    up = math.exp(0.5 * p[2]) / (p[0] * factor)
    down = math.exp(-0.5 * p[2]) * factor / p[0]
    s[0] += (e - a) * (1.0 - math.exp(-c[STEP_S] * ((f + 0.5) * up + (0.5 - f) * down)))
    s[1] = lag_after(a * c[LARGEST_NM], s[0] * c[LARGEST_NM], s[1], p[1], c[STEP_S])
    c[FORCE] = s[1] / c[LARGEST_NM]
    return s[1]


@kernel
def _cross_bridges(x, p, s, c):
    """p: 1/Tω, ζ, log ratio, smoothing. Second order; the rate depends on whether force is being made or lost."""
    made = math.tanh((x - s[0]) / (p[3] * c[LARGEST_NM]))
    rate = p[0] * math.exp(0.25 * p[2] * made)
    y = second_order_step(x, rate, p[1], s, 0, c[STEP_S])
    c[FORCE] = y / c[LARGEST_NM]
    return y


def _lags(base: Base, rng: Generator) -> tuple[float, float]:
    """The time constant that becomes asymmetric, and the other."""
    fast, slow = base.two_lags_s()
    return (slow, fast) if rng.random() < 0.7 else (fast, slow)


def _sign(rng: Generator) -> float:
    """1 where relaxation is slower, in three of four; -1 where development is."""
    return random_sign(rng, 0.75)


def thelen(rng: Generator, base: Base) -> Formulation:
    asymmetric, other = _lags(base, rng)
    sign = _sign(rng)
    exponent = float(rng.uniform(0.0, 1.0))
    return Formulation(
        "activation and deactivation time constants with 0.5 + 1.5 a",
        "Winters 1995; Thelen 2003",
        lambda m: [Stage("dynamics", _thelen, (asymmetric, other, math.exp(sign * m), exponent * min(m, 1.0)))],
        2.2,
        "log_ratio",
        {"slower": "relaxation" if sign > 0 else "development", "exponent": exponent},
    )


def de_groote(rng: Generator, base: Base) -> Formulation:
    asymmetric, other = _lags(base, rng)
    sign = _sign(rng)
    steepness, share = float(rng.uniform(5.0, 30.0)), float(rng.uniform(0.0, 0.5))
    return Formulation(
        "tanh-smoothed activation dynamics",
        "De Groote, Kinney, Rao and Fregly 2016",
        lambda m: [Stage("dynamics", _de_groote, (asymmetric, other, sign * m, steepness, share * min(m, 1.0)))],
        2.2,
        "log_ratio",
        {"slower": "relaxation" if sign > 0 else "development", "b": steepness, "share": share},
    )


def cross_bridges(rng: Generator, base: Base) -> Formulation:
    sign = _sign(rng)
    smooth = float(rng.uniform(0.02, 0.15))
    return Formulation(
        "attachment faster than detachment, smoothed, second order",
        "McCrea, Eng and Hodgson 2003 (development and relaxation impaired apart); rates after Huxley 1957",
        lambda m: [Stage("dynamics", _cross_bridges, (1.0 / base.t_omega_s, base.zeta, sign * m, smooth))],
        2.5,
        "log_ratio",
        {"slower": "relaxation" if sign > 0 else "development", "smoothing": smooth},
    )


FORMULATIONS = (thelen, de_groote, cross_bridges)

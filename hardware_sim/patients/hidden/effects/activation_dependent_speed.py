"""Activation-dependent speed: the muscle is faster or slower at high activation than at low."""

from __future__ import annotations

import math

from numpy.random import Generator

from hardware_sim.patients.hidden.base import Base, lag_after
from hardware_sim.patients.hidden.kernels import FORCE, LARGEST_NM, SPEED, STEP_S, Formulation, Stage, kernel


@kernel
def _by_level(x, p, s, c):
    """p: log of the speed's ratio between full and no force, lag s. s[0]: lagged force."""
    s[0] += (c[FORCE] - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    c[SPEED] *= math.exp(p[0] * (min(max(s[0], 0.0), 1.2) - 0.4))
    return x


@kernel
def _calcium_pump(x, p, s, c):
    """p: τ of calcium at half, τ of force, saturation of the pump. s: calcium, force.

    The pump takes calcium up at C (1 + σ) / (1 + σ C) (Michaelis-Menten), so it lags behind at high activation;
    release is written so that the steady calcium is the recruited share.
    """
    e = max(x / c[LARGEST_NM], 0.0)
    sigma = p[2]
    half = 1.0 + 0.5 * sigma
    before = s[0]
    rate = math.sqrt(1.0 + sigma) * half / p[0]  # the pump's speed at half activation stays near 1 / p[0]
    release = e / (1.0 + sigma * e)
    slope = rate * (release - before / (1.0 + sigma * before))
    guess = max(before + c[STEP_S] * slope, 0.0)
    s[0] += 0.5 * c[STEP_S] * (slope + rate * (release - guess / (1.0 + sigma * guess)))
    s[1] = lag_after(before * c[LARGEST_NM], s[0] * c[LARGEST_NM], s[1], p[1], c[STEP_S])
    c[FORCE] = s[1] / c[LARGEST_NM]
    return s[1]


@kernel
def _bound_calcium(x, p, s, c):
    """p: τ of calcium, τ of force, k. s: calcium, force. Force decays with τ1 + τ2 * (bound calcium)."""
    before = s[0]
    s[0] += (x / c[LARGEST_NM] - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[0]))
    bound = max(s[0], 0.0)
    tau = p[1] * (1.0 + p[2] * bound) / (1.0 + 0.4 * p[2])
    s[1] = lag_after(before * c[LARGEST_NM], s[0] * c[LARGEST_NM], s[1], tau, c[STEP_S])
    c[FORCE] = s[1] / c[LARGEST_NM]
    return s[1]


@kernel
def _cooperative(x, p, s, c):
    """p: τ of calcium, τ of force, k. s: calcium, force. Attached bridges help others attach: faster when strong."""
    before = s[0]
    s[0] += (x / c[LARGEST_NM] - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[0]))
    share = min(max(s[1] / c[LARGEST_NM], 0.0), 1.2)
    rate = (1.0 + p[2] * share) / (1.0 + 0.4 * p[2]) / p[1]
    s[1] = lag_after(before * c[LARGEST_NM], s[0] * c[LARGEST_NM], s[1], 1.0 / rate, c[STEP_S])
    c[FORCE] = s[1] / c[LARGEST_NM]
    return s[1]


def by_level(rng: Generator, _base: Base) -> Formulation:
    sign, lag = float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.01, 0.1))
    return Formulation(
        "all rates go with the level",
        "Hunt, Munih, Donaldson and Barr 1998",
        lambda m: [Stage("delay", _by_level, (sign * m, lag))],
        2.0,
        "log_speed_ratio",
        {"faster_when": "strong" if sign > 0 else "weak", "lag_s": lag},
    )


def calcium_pump(_rng: Generator, base: Base) -> Formulation:
    fast, slow = base.two_lags_s()
    return Formulation(
        "calcium pump saturates",
        "Michaelis-Menten uptake, Westerblad and Allen 1994; Stein, Bobet, Oğuztöreli and Fryer 1988",
        lambda m: [Stage("dynamics", _calcium_pump, (slow, fast, m))],
        8.0,
        "saturation",
    )


def bound_calcium(_rng: Generator, base: Base) -> Formulation:
    fast, slow = base.two_lags_s()
    return Formulation(
        "force decays more slowly with bound calcium",
        "Ding, Wexler and Binder-Macleod 2000: τ1 + τ2 CN / (Km + CN)",
        lambda m: [Stage("dynamics", _bound_calcium, (fast, slow, m))],
        8.0,
        "tau2_over_tau1",
    )


def cooperative(_rng: Generator, base: Base) -> Formulation:
    fast, slow = base.two_lags_s()
    return Formulation(
        "cooperative attachment, faster when strong",
        "Campbell 1997",
        lambda m: [Stage("dynamics", _cooperative, (fast, slow, m))],
        8.0,
        "cooperativity",
    )


FORMULATIONS = (by_level, calcium_pump, bound_calcium, cooperative)

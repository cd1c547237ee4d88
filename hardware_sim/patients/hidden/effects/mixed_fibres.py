"""Mixed fibres: fast and slow fibres answer side by side."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base, second_order_step
from stimrig.hardware_sim.patients.hidden.kernels import FORCE, LARGEST_NM, STEP_S, Formulation, Stage, kernel
from stimrig.hardware_sim.patients.hidden.written import Written, second_order_of


@kernel("dynamics")
def _two_branches(x, p, s, c):
    """p: 1/Tω fast, 1/Tω slow, ζ, fast share; last: whether the fast fibres are recruited first."""
    if p[4] > 0.5:
        fast = min(x, p[3] * c[LARGEST_NM])
        slow = x - fast
    else:
        fast, slow = p[3] * x, (1.0 - p[3]) * x
    y = second_order_step(fast, p[0], p[2], s, 0, c[STEP_S]) + second_order_step(slow, p[1], p[2], s, 2, c[STEP_S])
    c[FORCE] = y / c[LARGEST_NM]
    return y


@kernel("dynamics")
def _spectrum(x, p, s, c):
    """p: ζ, then seven shares and seven rates."""
    y = 0.0
    for i in range(7):
        y += second_order_step(p[1 + i] * x, p[8 + i], p[0], s, 2 * i, c[STEP_S])
    c[FORCE] = y / c[LARGEST_NM]
    return y


@kernel("dynamics")
def _slow_tail(x, p, s, c):
    """p: slow share, 1/Tω, ζ, time constant of the slow first-order fibres s."""
    fast = second_order_step(x, p[1], p[2], s, 0, c[STEP_S])
    s[2] += (x - s[2]) * (1.0 - math.exp(-c[STEP_S] / p[3]))
    y = (1.0 - p[0]) * fast + p[0] * s[2]
    c[FORCE] = y / c[LARGEST_NM]
    return y


@kernel("dynamics")
def _third_order(x, p, s, c):
    """p: slow share, 1/Tω, ζ, time constant of each of three lags s."""
    fast = second_order_step(x, p[1], p[2], s, 0, c[STEP_S])
    keep = math.exp(-c[STEP_S] / p[3])
    signal = x
    for i in range(3):
        s[2 + i] = signal + (s[2 + i] - signal) * keep
        signal = s[2 + i]
    y = (1.0 - p[0]) * fast + p[0] * signal
    c[FORCE] = y / c[LARGEST_NM]
    return y


def _apart(m: float, rate: float, zeta: float, share: float, ordered: float) -> tuple[float, ...]:
    return rate * math.exp(m * (1.0 - share)), rate * math.exp(-m * share), zeta, share, ordered


def spectrum(rng: Generator, base: Base) -> Formulation:
    share = rng.dirichlet(np.full(7, 4.0))
    z = np.linspace(-1.5, 1.5, 7)
    z = z - float(share @ z)
    return Formulation(
        "spectrum of contraction times",
        "spread of twitch times as in Fuglevand, Winter and Patla 1993",
        lambda m: [Stage(_spectrum, (base.zeta, *share, *(np.exp(-m * z) / base.t_omega_s)))],
        1.3,
        "log_spread",
        {"shares": share.tolist()},
    )


FORMULATIONS = (
    Written(
        "fast and slow in parallel",
        "Milner-Brown, Stein and Yemm 1973",
        _two_branches,
        2.3,
        "log_ratio",
        {"_base": second_order_of, "fast_share": (0.3, 0.7), "_ordered": 0.0},
        _apart,
    ),
    Written(
        "fast fibres recruited before the slow ones",
        "reversed order: Trimble and Enoka 1991; Gregory and Bickel 2005",
        _two_branches,
        2.3,
        "log_ratio",
        {"_base": second_order_of, "fast_share": (0.3, 0.7), "_ordered": 1.0},
        _apart,
    ),
    spectrum,
    Written(
        "second-order fast fibres, first-order slow ones",
        "sim",
        _slow_tail,
        0.7,
        "slow_share",
        {
            "_base": second_order_of,
            "tau_slow_s": lambda rng, base: float(np.exp(rng.uniform(np.log(2.5), np.log(8.0)))) * base.t_omega_s,
        },
    ),
)
KEPT_BACK = (
    Written(
        "slow fibres of third order",
        "sim",
        _third_order,
        0.8,
        "slow_share",
        {"_base": second_order_of, "lag_s": lambda rng, base: float(rng.uniform(1.0, 2.2)) * base.t_omega_s},
    ),
)

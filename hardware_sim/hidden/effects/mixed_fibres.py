"""Mixed fibres: fast and slow fibres answer side by side."""

from __future__ import annotations

import math

import numpy as np

from stimrig.hardware_sim.hidden.base import second_order_step
from stimrig.hardware_sim.hidden.forms import Effect, Numbers, draws, second_order
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, STEP_S

EFFECT = Effect()


def _apart(m: float, rate: float, zeta: float, share: float, ordered: float) -> tuple[float, ...]:
    return rate * math.exp(m * (1.0 - share)), rate * math.exp(-m * share), zeta, share, ordered


@EFFECT.form("fast and slow in parallel", "Milner-Brown, Stein and Yemm 1973")
@draws("dynamics", 2.3, "log_ratio", arrange=_apart, _base=second_order, fast_share=(0.3, 0.7), _ordered=0.0)
def _two_branches(x, p, s, c):
    """p: 1/Tω fast, 1/Tω slow, ζ, fast share; last: whether the fast fibres are recruited first."""
    if p[4] > 0.5:
        fast = min(x, p[3] * c[LARGEST_NM])
        slow = x - fast
    else:
        fast, slow = p[3] * x, (1.0 - p[3]) * x
    return second_order_step(fast, p[0], p[2], s, 0, c[STEP_S]) + second_order_step(slow, p[1], p[2], s, 2, c[STEP_S])


EFFECT.form(
    "fast fibres recruited before the slow ones",
    "reversed order: Trimble and Enoka 1991; Gregory and Bickel 2005",
    _base=second_order,
    fast_share=(0.3, 0.7),
    _ordered=1.0,
)(_two_branches)


SPREAD = 7


def _times(rng, base):
    share, z = rng.dirichlet(np.full(SPREAD, 4.0)), np.linspace(-1.5, 1.5, SPREAD)
    z = z - float(share @ z)
    return Numbers((base.t_omega_s, base.zeta, *share, *z), shares=share.tolist())


def _spectral(m: float, t_omega_s: float, zeta: float, *shares_and_z: float) -> tuple[float, ...]:
    return zeta, *shares_and_z[:SPREAD], *(np.exp(-m * np.array(shares_and_z[SPREAD:])) / t_omega_s)


@EFFECT.form("spectrum of contraction times", "spread of twitch times as in Fuglevand, Winter and Patla 1993")
@draws("dynamics", 1.3, "log_spread", arrange=_spectral, _times=_times)
def _spectrum(x, p, s, c):
    """p: ζ, then seven shares and seven rates."""
    y = 0.0
    for i in range(7):
        y += second_order_step(p[1 + i] * x, p[8 + i], p[0], s, 2 * i, c[STEP_S])
    return y


@EFFECT.form("second-order fast fibres, first-order slow ones", "sim")
@draws(
    "dynamics",
    0.7,
    "slow_share",
    _base=second_order,
    tau_slow_s=lambda rng, base: float(np.exp(rng.uniform(np.log(2.5), np.log(8.0)))) * base.t_omega_s,
)
def _slow_tail(x, p, s, c):
    """p: slow share, 1/Tω, ζ, time constant of the slow first-order fibres s."""
    fast = second_order_step(x, p[1], p[2], s, 0, c[STEP_S])
    s[2] += (x - s[2]) * (1.0 - math.exp(-c[STEP_S] / p[3]))
    return (1.0 - p[0]) * fast + p[0] * s[2]


@EFFECT.held_back("slow fibres of third order", "sim")
@draws(
    "dynamics",
    0.8,
    "slow_share",
    _base=second_order,
    lag_s=lambda rng, base: float(rng.uniform(1.0, 2.2)) * base.t_omega_s,
)
def _third_order(x, p, s, c):
    """p: slow share, 1/Tω, ζ, time constant of each of three lags s."""
    fast = second_order_step(x, p[1], p[2], s, 0, c[STEP_S])
    decay = math.exp(-c[STEP_S] / p[3])
    signal = x
    for i in range(3):
        s[2 + i] = signal + (s[2 + i] - signal) * decay
        signal = s[2 + i]
    return (1.0 - p[0]) * fast + p[0] * signal

"""Activation-dependent speed: the muscle is faster or slower at high activation than at low."""

from __future__ import annotations

import math

from stimrig.hardware_sim.hidden.base import force_after
from stimrig.hardware_sim.hidden.forms import Effect, Sign, draws, even, two_lags
from stimrig.hardware_sim.hidden.kernels import ACTIVATION, FORCE, LARGEST_NM, SPEED, STEP_S

EFFECT = Effect()


@EFFECT.form("all rates go with the level", "Hunt, Munih, Donaldson and Barr 1998")
@draws("delay", 2.0, "log_speed_ratio", faster_when=Sign(even, "strong", "weak"), lag_s=(0.01, 0.1))
def _by_level(x, p, s, c):
    """p: log of the speed's ratio between full and no force, lag s. s[0]: lagged force."""
    s[0] += (c[FORCE] - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    c[SPEED] *= math.exp(p[0] * (min(max(s[0], 0.0), 1.2) - 0.4))
    return x


@EFFECT.form(
    "calcium pump saturates",
    "Michaelis-Menten uptake, Westerblad and Allen 1994; Stein, Bobet, Oğuztöreli and Fryer 1988",
)
@draws("dynamics", 8.0, "saturation", _lags=two_lags)
def _calcium_pump(x, p, s, c):
    """p: saturation of the pump, τ of force, τ of calcium at half. s: calcium, force.

    The pump takes calcium up at C (1 + σ) / (1 + σ C) (Michaelis-Menten), so it lags behind at high activation;
    release is written so that the steady calcium is the recruited share.
    """
    e = max(x / c[LARGEST_NM], 0.0)
    sigma = p[0]
    half = 1.0 + 0.5 * sigma
    before = s[0]
    rate = math.sqrt(1.0 + sigma) * half / p[2]  # the pump's speed at half activation stays near 1 / p[2]
    release = e / (1.0 + sigma * e)
    slope = rate * (release - before / (1.0 + sigma * before))
    guess = max(before + c[STEP_S] * slope, 0.0)
    s[0] += 0.5 * c[STEP_S] * (slope + rate * (release - guess / (1.0 + sigma * guess)))
    return force_after(before, s, p[1], c)


@EFFECT.form(
    "force decays more slowly with bound calcium", "Ding, Wexler and Binder-Macleod 2000: τ1 + τ2 CN / (Km + CN)"
)
@draws("dynamics", 8.0, "tau2_over_tau1", _lags=two_lags)
def _bound_calcium(x, p, s, c):
    """p: k, τ of calcium, τ of force. s: calcium, force. Force decays with τ1 + τ2 * (bound calcium)."""
    before = s[0]
    s[0] += (x / c[LARGEST_NM] - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    bound = max(s[0], 0.0)
    tau = p[2] * (1.0 + p[0] * bound) / (1.0 + 0.4 * p[0])
    return force_after(before, s, tau, c)


@EFFECT.form("cooperative attachment, faster when strong", "Campbell 1997")
@draws("dynamics", 8.0, "cooperativity", _lags=two_lags)
def _cooperative(x, p, s, c):
    """p: k, τ of calcium, τ of force. s: calcium, force. Attached bridges help others attach: faster when strong."""
    before = s[0]
    s[0] += (x / c[LARGEST_NM] - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    share = min(max(s[1] / c[LARGEST_NM], 0.0), 1.2)
    rate = (1.0 + p[0] * share) / (1.0 + 0.4 * p[0]) / p[2]
    return force_after(before, s, 1.0 / rate, c)


@EFFECT.held_back(
    "rates go with the recruited share", "local models at several levels, Hunt, Munih, Donaldson and Barr 1998"
)
@draws("delay", 4.0, "speed_gain", faster_when=Sign(even, "more recruited", "less recruited"), exponent=(0.6, 2.0))
def _by_recruitment(x, p, s, c):
    """p: size (signed), exponent. Rates go with how many units are being stimulated, not with their force."""
    a = min(max(c[ACTIVATION], 0.0), 1.2)
    c[SPEED] *= 1.0 + p[0] * a ** p[1] if p[0] > 0.0 else 1.0 / (1.0 - p[0] * a ** p[1])
    return x

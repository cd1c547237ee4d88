"""Asymmetric relaxation: torque develops and decays at different speeds."""

from __future__ import annotations

import math

from stimrig.hardware_sim.hidden.base import force_after, lag_after, second_order_step
from stimrig.hardware_sim.hidden.forms import Effect, Sign, draws, mostly, second_order, two_lags
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, STEP_S

EFFECT = Effect()


def _lags(rng, base):
    """The time constant that becomes asymmetric, and the other."""
    fast, slow = base.two_lags_s()
    return (slow, fast) if rng.random() < 0.7 else (fast, slow)


SLOWER = Sign(mostly(0.75), "relaxation", "development")


@EFFECT.form("activation and deactivation time constants with 0.5 + 1.5 a", "Winters 1995; Thelen 2003")
@draws(
    "dynamics",
    2.2,
    "log_ratio",
    arrange=lambda m, asymmetric, other, exponent: (asymmetric, other, math.exp(m), exponent * min(abs(m), 1.0)),
    _lags=_lags,
    slower=SLOWER,
    exponent=(0.0, 1.0),
)
def _thelen(x, p, s, c):
    """p: τ1, τ2, ratio, exponent of (0.5 + 1.5 a). s: activation, torque. Activation first, then a lag."""
    a = min(max(s[0], 0.0), 1.2)
    e = x / c[LARGEST_NM]
    factor = (0.5 + 1.5 * a) ** p[3]
    tau = p[0] / math.sqrt(p[2]) * factor if e > a else p[0] * math.sqrt(p[2]) / factor
    before = s[0]
    s[0] += (e - s[0]) * (1.0 - math.exp(-c[STEP_S] / tau))
    return force_after(before, s, p[1], c)


@EFFECT.form("tanh-smoothed activation dynamics", "De Groote, Kinney, Rao and Fregly 2016")
@draws(
    "dynamics",
    2.2,
    "log_ratio",
    arrange=lambda m, asymmetric, other, steepness, share: (asymmetric, other, m, steepness, share * min(abs(m), 1.0)),
    _lags=_lags,
    slower=SLOWER,
    b=(5.0, 30.0),
    share=(0.0, 0.5),
)
def _de_groote(x, p, s, c):
    """p: τ1, τ2, log ratio, b, share of the activation factor. Smooth change between the two time constants."""
    e = x / c[LARGEST_NM]
    a = s[0]
    f = 0.5 * math.tanh(p[3] * (e - a))
    factor = 1.0 + p[4] * (max(a, 0.0) - 0.4)
    up = math.exp(0.5 * p[2]) / (p[0] * factor)
    down = math.exp(-0.5 * p[2]) * factor / p[0]
    s[0] += (e - a) * (1.0 - math.exp(-c[STEP_S] * ((f + 0.5) * up + (0.5 - f) * down)))
    return force_after(a, s, p[1], c)


@EFFECT.form(
    "attachment faster than detachment, smoothed, second order",
    "McCrea, Eng and Hodgson 2003 (development and relaxation impaired apart); rates after Huxley 1957",
)
@draws("dynamics", 2.5, "log_ratio", _base=second_order, slower=SLOWER, smoothing=(0.02, 0.15))
def _cross_bridges(x, p, s, c):
    """p: log ratio, 1/Tω, ζ, smoothing. Second order; the rate depends on whether force is being made or lost."""
    attached = math.tanh((x - s[0]) / (p[3] * c[LARGEST_NM]))
    rate = p[1] * math.exp(0.25 * p[0] * attached)
    return second_order_step(x, rate, p[2], s, 0, c[STEP_S])


@EFFECT.held_back(
    "torque falls no faster than the bridges let go",
    "linear phase of relaxation, Tesi, Piroddi, Colomo and Poggesi 2002",
)
@draws("dynamics", 3.0, "shortest_fall_s", _lags=two_lags)
def _limited_fall(x, p, s, c):
    """p: s it takes at least to fall from the largest torque, τ1, τ2. s: two lags; the second falls no faster."""
    before = s[0]
    s[0] += (x - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    goal = lag_after(before, s[0], s[1], p[2], c[STEP_S])
    fastest = c[STEP_S] * c[LARGEST_NM] / p[0]
    change = goal - s[1]
    s[1] += change if change > 0.0 else -fastest * math.tanh(-change / fastest)
    return s[1]

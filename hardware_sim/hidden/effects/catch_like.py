"""Catch-like property: the onset of a train yields more torque than its later pulses."""

from __future__ import annotations

import math

from stimrig.hardware_sim.hidden.forms import Effect, draws
from stimrig.hardware_sim.hidden.kernels import ACTIVATION, COUNT, PAUSE_S, STEP_S

EFFECT = Effect()


@EFFECT.form("gain of the first pulses", "Binder-Macleod and Kesar 2005; Bickel, Slade and Dudley 2004")
@draws("gain", 2.5, "first_gain", lasts_pulses=(3.0, 12.0), recovery_s=(0.1, 0.6))
def _first_pulses(x, p, s, c):
    rested = 1.0 - math.exp(-c[PAUSE_S] / p[2])
    return x * (1.0 + p[0] * rested * math.exp(-(max(c[COUNT], 1.0) - 1.0) / p[1]))


@EFFECT.form(
    "calcium store that runs down",
    "store depletion as in Tsodyks and Markram 1997, for calcium release after Duchateau and Hainaut 1986",
)
@draws("gain", 4.0, "gain", refill_s=(0.3, 1.2), empty_s=(0.1, 0.3))
def _store(x, p, s, c):
    """p: gain, refill s, emptying s. s[0]: what the store has lost. Calcium release from a store that runs down."""
    if c[ACTIVATION] > 0.0:
        s[0] += c[STEP_S] * c[ACTIVATION] * (1.0 - s[0]) / p[2]
    s[0] -= c[STEP_S] * s[0] / p[1]
    return x * (1.0 + p[0] * (1.0 - s[0]))


@EFFECT.form("burst at the onset of a train", "stiffness of the series elastic element, Parmiggiani and Stein 1981")
@draws("gain", 3.0, "gain", peak_s=(0.06, 0.2), pause_s=(0.08, 0.5))
def _burst(x, p, s, c):
    """p: gain, time of its peak s, pause it needs s. s: age of the train, age of the pause, readiness.

    An alpha function from the moment the muscle is engaged again.
    """
    if c[ACTIVATION] > 0.03:
        if s[1] > 0.0:
            s[2] = 1.0 - math.exp(-s[1] / p[2]) if s[3] > 0.0 else 1.0
            s[0] = 0.0
            s[1] = 0.0
            s[3] = 1.0
        s[0] += c[STEP_S]
    else:
        s[1] += c[STEP_S]
    z = s[0] / p[1]
    return x * (1.0 + p[0] * s[2] * (z + 0.3) * math.exp(-z))


@EFFECT.held_back("rest primes the next onset", "Lee, Gerdom and Binder-Macleod 1999, in one state")
@draws("gain", 4.0, "gain", priming_s=(0.1, 0.5), use_s=(0.1, 0.3))
def _primed(x, p, s, c):
    """p: gain, priming s, use s. s[0]: primed share; grows at rest, used up by activity in proportion to itself."""
    a = min(max(c[ACTIVATION], 0.0), 1.0)
    gain = 1.0 + p[0] * s[0] * s[0]
    s[0] += c[STEP_S] * ((1.0 - a) * (1.0 - s[0]) / p[1] - a * s[0] / p[2])
    return x * gain

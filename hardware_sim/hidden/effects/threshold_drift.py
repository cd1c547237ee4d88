"""Threshold drift: over minutes, the same pulse width reaches fewer or more nerve fibres."""

from __future__ import annotations

import math

import numpy as np

from stimrig.hardware_sim.hidden.forms import Effect, Numbers, Sign, draws, mostly
from stimrig.hardware_sim.hidden.kernels import STEP_S, TIME_S, WIDTH_US, smooth_table

EFFECT = Effect("larger")
MOSTLY_UP = Sign(mostly(0.65))


@EFFECT.form("electrode settles like an RC", "electrode-skin impedance, Dorgan and Reilly 1999")
@draws("electrode", 90.0, "final_shift_us", tau_s=(10.0, 60.0), sign=MOSTLY_UP)
def _warm_up(x, p, s, c):
    """p: shift µs, time constant s. An electrode that settles: the width lost goes to its end like an RC."""
    return max(x - p[0] * (1.0 - math.exp(-c[TIME_S] / p[1])), 0.0) if x > 0.0 else 0.0


@EFFECT.form("current falls, thresholds scale by Lapicque's law", "Lapicque 1907; Geddes 2004")
@draws(
    "electrode",
    0.35,
    "share_of_current",
    tau_s=(15.0, 80.0),
    sign=Sign(lambda rng: -MOSTLY_UP.draw(rng)),
    current_over_rheobase=(1.6, 3.0),
)
def _strength_duration(x, p, s, c):
    """p: change of the current's share, time constant s, overdrive I/rheobase at the start.

    Lapicque: a fibre answers where I >= Irh (1 + chronaxie/width), so a change of I scales every threshold width by
    the ratio of (I/Irh - 1).
    """
    change = p[0] * (1.0 - math.exp(-c[TIME_S] / p[1]))
    return max(x * (p[2] * (1.0 + change) - 1.0) / (p[2] - 1.0), 0.0)


def _knots(rng, _base):
    sign = MOSTLY_UP.draw(rng)
    steps = np.abs(rng.normal(1.0, 0.5, 199)) * np.exp(-np.arange(199) / 12.0)
    knots = np.concatenate([[0.0], np.cumsum(steps)])
    return Numbers(knots * (sign / knots[4]), sign=sign)


@EFFECT.form("smooth wander in one direction", "sweat and gel, no law")
@draws("electrode", 80.0, "shift_at_fourth_knot_us", knots_s=(10.0, 18.0), _knots=_knots)
def _wander(x, p, s, c):
    """p: size µs, spacing of the knots s, then 200 knots: sweat and skin, without a law."""
    if x <= 0.0:
        return 0.0
    return max(x - p[0] * smooth_table(p, 2, 200, c[TIME_S] / p[1]), 0.0)


@EFFECT.form("linear, then settled", "sim")
@draws("electrode", 2.0, "us_per_s", sign=MOSTLY_UP, until_s=(60.0, 200.0))
def _linear(x, p, s, c):
    return max(x - p[0] * min(c[TIME_S], p[1]), 0.0) if x > 0.0 else 0.0


@EFFECT.held_back(
    "goes with the logarithm of time", "constant-phase settling of the electrode interface, McAdams and Jossinet 1995"
)
@draws("electrode", 90.0, "us_per_decade", first_s=(3.0, 12.0), sign=Sign())
def _settling(x, p, s, c):
    """p: µs a decade of time, first time s. Charge transfer at the interface settles with the logarithm of time."""
    return max(x - p[0] * math.log10(1.0 + c[TIME_S] / p[1]), 0.0) if x > 0.0 else 0.0


@EFFECT.held_back("goes with the charge delivered", "electrode polarisation, Merrill, Bikson and Jefferys 2005")
@draws("electrode", 6.0, "us_per_s_of_charge", sign=Sign())
def _with_charge(x, p, s, c):
    """p: µs after a second of charge of 300 µs pulses. s[0]: charge so far. Polarisation that stays."""
    s[0] += c[STEP_S] * c[WIDTH_US] / 300.0
    return max(x - p[0] * s[0], 0.0) if x > 0.0 else 0.0

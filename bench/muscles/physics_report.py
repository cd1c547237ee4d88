"""Muscles of other physics to report on, that nobody develops on: one each of the fields of `physics_new`."""

from __future__ import annotations

import math

from bench.muscles.mechanism import by_name, mechanism
from bench.muscles.physics_places import share_above, two_lags
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, PULSE, STEP_S, WIDTH_US, helper

_muscle = {"first_s": (0.03, 0.08), "second_s": (0.08, 0.25)}


@helper
def share_of_group(x, k, count, c):
    """Share of the k-th of `count` groups of units that this recruited torque holds; small thresholds come first."""
    return min(max(x / c[LARGEST_NM] * count - k, 0.0), 1.0)


@mechanism(
    "each pulse releases a share of the calcium store, and a pump that saturates returns it: Baylor and Hollingworth"
    " 2003; Posterino and Lamb 2003",
    "catch_like asymmetric_relaxation fatigue",
    "",
    pumps_per_s=(55.0, 120.0),
    half_pump=(0.5, 2.0),
    empties=(0.004, 0.02),
    refills_s=(0.5, 4.0),
    half_force=(0.3, 0.9),
    force_s=(0.06, 0.2),
)
def calcium_store(x, p, s, c):
    """p: scale, pump's largest rate and half of it, lost by a pulse, refills s, half of force, force s.

    s: force; s[10:26], s[30:46]: calcium and lost store of 16 groups of fibres. Calcium is in releases of a full store.
    """
    count, bound = 16, 0.0
    for k in range(count):
        fires = share_of_group(x, k, count, c) if c[PULSE] > 0.0 else 0.0
        s[10 + k] += fires * (1.0 - s[30 + k])
        s[30 + k] += p[3] * fires * (1.0 - s[30 + k]) - c[STEP_S] * s[30 + k] / p[4]
        s[10 + k] *= math.exp(-c[STEP_S] * p[1] / (p[2] + s[10 + k]))
        square = s[10 + k] * s[10 + k]
        bound += square / (square + p[5] * p[5]) / count
    s[0] += (bound - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[6]))
    return p[0] * c[LARGEST_NM] * s[0]


@mechanism(
    "end-plates run out of docked vesicles, and fibres with a small safety factor drop out: Elmqvist and Quastel 1965;"
    " Wood and Slater 2001",
    "fatigue",
    "strength",
    **_muscle,
    gone=(0.35, 0.55),
    refills_s=(0.5, 3.0),
    facilitates=(0.0, 0.15),
    safety=(1.7, 2.4),
    spread=(0.06, 0.2),
)
def end_plates(x, p, s, c):
    """p: scale, τ s twice, share gone in a long train, refills s, facilitation by a pulse, safety factor, its spread.

    s: two lags; s[10:26], s[30:46]: vesicles gone and facilitation of 16 groups of units, s[50:66]: what the last
    pulse transmitted. Facilitation lasts 0.15 s; the safety factor is that of the rested end-plate.
    """
    count, drive = 16, 0.0
    released = p[3] / (1.0 - p[3]) * 0.025 / p[4]
    for k in range(count):
        if c[PULSE] > 0.0:
            fires = share_of_group(x, k, count, c)
            quanta = (1.0 - s[10 + k]) * (1.0 + s[30 + k])
            s[50 + k] = fires / (1.0 + math.exp(-(quanta - 1.0 / p[6]) / p[7]))
            s[10 + k] += fires * min(released * quanta, 1.0 - s[10 + k])
            s[30 + k] += fires * p[5]
        s[10 + k] *= math.exp(-c[STEP_S] / p[4])
        s[30 + k] *= math.exp(-c[STEP_S] / 0.15)
        drive += s[50 + k] / count if x > 0.0 else 0.0
    return p[0] * c[LARGEST_NM] * two_lags(drive, p, s, c)


@helper
def passed(width_us, skin, charges_us, limit):
    """Charge of a pulse, in µs of the set current, through skin (resistance, time to charge it) over tissue of 1."""
    if 1.0 + skin <= limit:
        return width_us
    at_limit_us = -charges_us * math.log(1.0 - (limit - 1.0) / skin)
    if width_us <= at_limit_us:
        return width_us
    lasting, beyond_us, falls_us = limit / (1.0 + skin), width_us - at_limit_us, charges_us / (1.0 + skin)
    return at_limit_us + lasting * beyond_us + (1.0 - lasting) * falls_us * (1.0 - math.exp(-beyond_us / falls_us))


@mechanism(
    "a stimulator at its voltage limit, on skin whose resistance falls under charge: Dorgan and Reilly 1999; Vargas"
    " Luna and others 2015",
    "threshold_drift",
    "width that acts",
    **_muscle,
    half_at_us_share=(0.4, 1.2),
    spread_us=(8.0, 20.0),
    skin=(4.0, 12.0),
    charges_us=(25.0, 100.0),
    limit=(1.5, 2.2),
    falls=(0.6, 0.9),
    opens_s=(1.0, 4.0),
    closes_s=(1.0, 5.0),
)
def voltage_limit(x, p, s, c):
    """p: scale, τ s twice, width at half of the axons µs, spread µs, skin's resistance and the time to charge it µs.

    p[7:]: voltage limit, share of the resistance that charge takes away, opens s, closes s. s: two lags, what has
    opened. Skin is a resistance beside a capacitance: current is as set until the limit, then it falls.
    """
    half = passed(p[3], p[5], p[6], p[7])
    passes = passed(c[WIDTH_US], p[5] * (1.0 - p[8] * s[2]), p[6] * (1.0 - p[8] * s[2]), p[7])
    s[2] += c[STEP_S] * (passes / half * (1.0 - s[2]) / p[9] - s[2] / p[10])
    return p[0] * c[LARGEST_NM] * two_lags(share_above(passes, half, p[4]), p, s, c)


@mechanism(
    "idle bridges of the relaxed antagonists hold the arm until it moves, and form again at rest: Lakie and Robson"
    " 1988; Campbell and Moss 2002",
    "series_compliance",
    "torque at the cell",
    **_muscle,
    holds=(0.08, 0.25),
    reach=(0.03, 0.15),
    forms_s=(0.8, 6.0),
    viscous_s=(0.01, 0.05),
)
def idle_bridges(x, p, s, c):
    """p: scale, τ s twice, torque held by all bridges, travel that they reach, time to form s, viscosity s.

    s: two lags, travel in the pads, strain of the bridges as a share of their reach, share that is detached.
    """
    torque = two_lags(x / c[LARGEST_NM], p, s, c)
    step = 0.125 * c[STEP_S]
    for _ in range(8):
        bound = 1.0 - s[4]
        speed = (torque - s[2] - p[3] * bound * s[3]) / p[6]
        s[2] += step * speed
        formed = s[4] / p[5]
        s[3] += step * ((speed - abs(speed) * s[3]) / p[4] - s[3] * formed / max(bound, 0.05))
        s[4] += step * (bound * abs(speed) / (4.0 * p[4]) - formed)
    return p[0] * c[LARGEST_NM] * s[2]


@mechanism(
    "the load cell's amplifier rectifies the stimulus, picked up the more the closer the arm is pressed: McGill and"
    " others 1982; Kitchin, Counts and Gerstenhaber 2003",
    "",
    "torque at the cell",
    **_muscle,
    offset=(0.06, 0.2),
    presses=(0.2, 1.0),
    holds_s=(0.05, 0.4),
    nulls_s=(1.0, 6.0),
)
def rectified_stimulus(x, p, s, c):
    """p: scale, τ s twice, offset by pulses of 300 µs, pick-up gained by pressing, filter s, nulling s.

    s: two lags, offset, what the amplifier has nulled of it.
    """
    torque = two_lags(x / c[LARGEST_NM], p, s, c)
    if c[PULSE] > 0.0:
        pick_up = 1.0 + p[4] * torque
        s[2] += p[3] * c[WIDTH_US] / 300.0 * pick_up * pick_up * 0.025 / p[5]
    s[2] *= math.exp(-c[STEP_S] / p[5])
    s[3] += (s[2] - s[3]) * c[STEP_S] / p[6]
    return p[0] * c[LARGEST_NM] * (torque + s[2] - s[3])


REPORT = by_name(calcium_store, end_plates, voltage_limit, idle_bridges, rectified_stimulus)

"""Muscles of other physics to develop on: one of contraction, nerve, electrode, cuff and sensor each.

As `physics`; `physics_report` has as many to report on.
"""

from __future__ import annotations

import math

from bench.muscles.mechanism import by_name, mechanism
from bench.muscles.physics_places import share_above, two_lags
from stimrig.hardware_sim.hidden.base import lag_after
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, PULSE, STEP_S, WIDTH_US

_muscle = {"first_s": (0.03, 0.08), "second_s": (0.08, 0.25)}


@mechanism(
    "work of shortening against the tendon depresses force until the muscle relaxes: Herzog, Leonard and Wu 2000;"
    " McGowan, Neptune and Herzog 2010",
    "series_compliance",
    "strength",
    activation_s=(0.03, 0.1),
    shortens_s=(0.08, 0.25),
    depression=(0.8, 2.5),
    most=(0.35, 0.6),
    relaxed_s=(0.15, 0.8),
)
def shortening_work(x, p, s, c):
    """p: scale, activation s, shortening s, depression by the work of one full rise, its most, time to relax s.

    s: activation, force, depression. A linear tendon stretches in proportion to force, so work is the integral of F dF.
    """
    drive = x / c[LARGEST_NM]
    s[0] = lag_after(drive, drive, s[0], p[1], c[STEP_S])
    before = s[1]
    s[1] += (s[0] * (1.0 - s[2]) - before) * (1.0 - math.exp(-c[STEP_S] / p[2]))
    s[2] += p[3] * before * max(s[1] - before, 0.0) * (1.0 - s[2] / p[4])
    idle = max(1.0 - s[0], 0.0)
    s[2] -= c[STEP_S] * idle * idle * s[2] / p[5]
    return p[0] * c[LARGEST_NM] * s[1]


@mechanism(
    "potassium that firing axons leave around each other first excites, then blocks: Frankenhaeuser and Hodgkin 1956;"
    " Bellinger, Miyazawa and Steinmetz 2008",
    "fatigue threshold_drift",
    "width that acts, strength",
    **_muscle,
    half_at_us_share=(0.3, 0.8),
    spread_us=(12.0, 35.0),
    excites=(0.15, 0.4),
    blocks_at=(0.3, 0.6),
    fills_s=(1.0, 4.0),
    clears_s=(1.0, 4.0),
)
def bundle_potassium(x, p, s, c):
    """p: scale, τ s twice, width at half µs, spread µs, fall of thresholds, first block at, fills s, clears s.

    s: two lags, potassium, which all of 16 groups of axons share.
    """
    count, fired, drive = 16, 0.0, 0.0
    for k in range(count):
        rank = (k + 0.5) / count
        needs = max(p[3] + p[4] * math.log(rank / (1.0 - rank)), 15.0) * (1.0 - p[5] * s[2])
        fires = share_above(c[WIDTH_US], needs, 2.0)
        tolerates = p[6] + 0.5 * ((7 * k + 3) % count) / count
        fired += fires / count
        drive += fires / (1.0 + math.exp((s[2] - tolerates) / 0.04)) / count
    s[2] += c[STEP_S] * (fired * (1.0 - s[2]) / p[7] - s[2] / p[8])
    return p[0] * c[LARGEST_NM] * two_lags(drive, p, s, c)


@mechanism(
    "charge that pulses leave on the electrode's double layer, bounded by faradaic leakage: Huang, Carter and Shepherd"
    " 2001; Merrill, Bikson and Jefferys 2005",
    "recruitment_hysteresis threshold_drift",
    "width that acts",
    **_muscle,
    half_at_us_share=(0.2, 0.6),
    spread_us=(12.0, 35.0),
    takes=(0.25, 0.6),
    discharges_s=(0.3, 2.0),
    leaks_per_s=(0.05, 0.5),
)
def double_layer(x, p, s, c):
    """p: scale, τ s twice, width at half of the axons µs, spread µs, taken from a pulse, discharges s, leaks per s.

    s: two lags, potential, width that reaches the nerve. What is left flows back as current that opposes the pulse.
    """
    if c[PULSE] > 0.0:
        s[3] = c[WIDTH_US] - p[3] * p[5] * s[2]
        s[2] += c[WIDTH_US] / p[3] * 0.025 / p[6]
    s[2] -= c[STEP_S] * (s[2] / p[6] + p[7] * math.sinh(min(s[2] / 0.4, 6.0)))
    drive = share_above(max(s[3], 0.0), p[3], p[4]) if c[WIDTH_US] > 0.0 else 0.0
    return p[0] * c[LARGEST_NM] * two_lags(drive, p, s, c)


@mechanism(
    "the elbow flexes into pads that yield and creep, so that fibre length and moment arm change: Zajac 1989; Murray,"
    " Delp and Buchanan 1995",
    "series_compliance",
    "strength, torque at the cell",
    **_muscle,
    lasting=(0.3, 0.7),
    creep_s=(0.6, 5.0),
    viscous_s=(0.02, 0.08),
    shortens=(0.15, 0.5),
    beyond_optimum=(-0.4, 0.2),
    arm=(-0.35, 0.1),
)
def yielding_cuff(x, p, s, c):
    """p: scale, τ s twice, stiffness that lasts, creep s, viscosity s, length-tension, offset, change of moment arm.

    s: two lags, flexion (1 at full torque), that of the creeping part.
    """
    active = two_lags(x / c[LARGEST_NM], p, s, c)
    step, pads = 0.125 * c[STEP_S], 0.0
    for _ in range(8):
        pads = p[3] * s[2] + (1.0 - p[3]) * (s[2] - s[3])
        length = 1.0 - p[6] * s[2] * (s[2] - 2.0 * p[7])
        torque = active * max(length, 0.1) * max(1.0 + p[8] * s[2], 0.1)
        s[2] += step * (torque - pads) / p[5]
        s[3] += step * (s[2] - s[3]) / p[4]
    return p[0] * c[LARGEST_NM] * pads


@mechanism(
    "a polymer force sensor: contact grows as a power of force and creeps over decades, the slower when unloaded: Hall"
    " and others 2008; Paredes-Madrid and others 2017",
    "",
    "torque at the cell",
    **_muscle,
    power=(0.8, 0.96),
    creeps=(0.06, 0.18),
    fastest_s=(0.15, 0.5),
    unloads_slower=(1.5, 4.0),
)
def polymer_cell(x, p, s, c):
    """p: scale, τ s twice, power of force, share that creeps, fastest creep s, how much slower it unloads.

    s: two lags; s[10:13]: creep of three elements, each six times slower than the one before.
    """
    contact = two_lags(x / c[LARGEST_NM], p, s, c) ** p[3]
    reading, tau = (1.0 - p[4]) * contact, p[5]
    for k in range(3):
        slower = p[6] if contact < s[10 + k] else 1.0
        s[10 + k] += (contact - s[10 + k]) * (1.0 - math.exp(-c[STEP_S] / (tau * slower)))
        reading += p[4] / 3.0 * s[10 + k]
        tau *= 6.0
    return p[0] * c[LARGEST_NM] * reading


NEW = by_name(shortening_work, bundle_potassium, double_layer, yielding_cuff, polymer_cell)

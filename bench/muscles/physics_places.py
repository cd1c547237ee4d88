"""Muscles whose departure from the plain structure lies elsewhere: in spinal cord, axons, electrode or fixture.

As `physics`; the muscle itself is two lags.
"""

from __future__ import annotations

import math

from bench.muscles.mechanism import by_name, mechanism
from stimrig.hardware_sim.hidden.base import delayed, lag_after
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, PULSE, STEP_S, WIDTH_US, helper

_muscle = {"first_s": (0.03, 0.08), "second_s": (0.08, 0.25)}


@helper
def two_lags(drive, p, s, c):
    """The muscle of most here: p[1], p[2] its time constants, s[0], s[1] its state."""
    before = s[0]
    s[0] = lag_after(drive, drive, before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[2], c[STEP_S])
    return s[1]


@helper
def share_above(width_us, half_us, spread_us):
    """Share of axons that a pulse of this width reaches: a logistic curve; none without a pulse."""
    return 1.0 / (1.0 + math.exp(-(width_us - half_us) / spread_us)) if width_us > 0.0 else 0.0


@mechanism(
    "wide pulses reach sensory axons, whose motoneurons go on by plateau potentials that warm up: Dean, Yates and"
    " Collins 2007; Bennett and others 1998",
    "recruitment_hysteresis mixed_fibres potentiation asymmetric_relaxation",
    "strength",
    **_muscle,
    central=(0.25, 0.5),
    afferents_at_us_share=(0.3, 0.9),
    spread_us=(8.0, 30.0),
    volley_s=(0.05, 0.2),
    persists=(0.6, 1.2),
    warms_s=(0.8, 2.5),
)
def central_plateau(x, p, s, c):
    """p: scale, τ s twice, central share, width at half of the afferents µs, spread µs, volley s, persistence, warms s.

    s: two lags, volley, warmth; s[10:30]: plateau of each of 20 motoneurons, 0 or 1 at rest. A plateau holds itself
    while persistence × warmth exceeds what its motoneuron needs; warmth follows the volley, and so it ends.
    """
    count, central, step = 20, 0.0, c[STEP_S]
    s[2] += (share_above(c[WIDTH_US], p[4], p[5]) - s[2]) * (1.0 - math.exp(-step / p[6]))
    s[3] += (s[2] - s[3]) * (1.0 - math.exp(-step / p[8]))
    for k in range(count):
        needs = 0.2 + 0.65 * k / (count - 1.0)
        excess = s[2] + p[7] * s[3] * s[10 + k] - needs
        target = min(max(0.5 + excess / 0.08, 0.0), 1.0)
        s[10 + k] += (target - s[10 + k]) * (1.0 - math.exp(-step / 0.05))
        central += s[10 + k] / count
    drive = (1.0 - p[3]) * x / c[LARGEST_NM] + p[3] * central
    return p[0] * c[LARGEST_NM] * two_lags(drive, p, s, c)


@mechanism(
    "the bulging muscle carries the nerve away from the electrode: position-dependent recruitment, Grill 2006",
    "asymmetric_relaxation catch_like",
    "width that acts",
    **_muscle,
    half_at_us_share=(0.3, 0.8),
    spread_us=(15.0, 40.0),
    moves=(0.35, 0.9),
    tissue_s=(0.1, 0.6),
)
def moving_electrode(x, p, s, c):
    """p: scale, τ s twice, width at half of the axons µs, spread µs, by how much of it torque moves it, tissue s.

    s: two lags, what the tissue has moved. The loop's gain stays below 6, under the 8 from which three lags swing on.
    """
    half = p[3] * (1.0 + p[5] * s[2])
    torque = two_lags(share_above(c[WIDTH_US], half, p[4]), p, s, c)
    s[2] += (torque - s[2]) * (1.0 - math.exp(-c[STEP_S] / p[6]))
    return p[0] * c[LARGEST_NM] * torque


@mechanism(
    "the forearm on a viscoelastic cushion, held back by a strap's dry friction: Zener's solid; Dahl 1968",
    "series_compliance",
    "torque at the cell",
    **_muscle,
    lasting=(0.4, 0.8),
    creep_s=(0.5, 4.0),
    dry=(0.04, 0.15),
    builds_over=(0.03, 0.15),
    viscous_s=(0.01, 0.04),
)
def dry_cushion(x, p, s, c):
    """p: scale, τ s twice, stiffness that lasts, creep s, friction, travel over which it builds, viscosity s.

    s: two lags, travel, that of the creeping part, friction. The cell feels the cushion, the strap takes the friction.
    """
    torque = two_lags(x / c[LARGEST_NM], p, s, c)
    step = 0.125 * c[STEP_S]
    cell_force = 0.0
    for _ in range(8):
        cell_force = p[3] * s[2] + (1.0 - p[3]) * (s[2] - s[3])
        speed = (torque - cell_force - s[4]) / p[7]
        s[2] += step * speed
        s[3] += step * (s[2] - s[3]) / p[4]
        s[4] += step * (p[5] * speed - abs(speed) * s[4]) / p[6]
    return p[0] * c[LARGEST_NM] * cell_force


@mechanism(
    "a reflex beside the direct way, worn by each pulse and held down by tension, late: Crone and Nielsen 1989 and Ib",
    "catch_like asymmetric_relaxation",
    "strength",
    first_s=(0.03, 0.08),
    second_s=(0.06, 0.2),
    reflex=(0.6, 2.0),
    worn=(0.03, 0.15),
    rests_s=(0.5, 3.0),
    held_down=(0.5, 2.0),
    late_s=(0.04, 0.15),
)
def worn_reflex(x, p, s, c):
    """p: scale, τ s twice, reflex's size, worn by a pulse, rests s, held down by tension, late s.

    s: place in a ring, two lags, wear; s[100:612]: the ring. The reflex is largest where half of the axons answer.
    """
    recruited = min(max(x / c[LARGEST_NM], 0.0), 1.0)
    if c[PULSE] > 0.0:
        s[3] += p[4] * (1.0 - s[3])
    s[3] *= math.exp(-c[STEP_S] / p[5])
    sensed_tension = delayed(s[2], p[7] / c[STEP_S], s, 100, 512)
    drive = recruited + p[3] * recruited * (1.0 - recruited) * (1.0 - s[3]) * max(1.0 - p[6] * sensed_tension, 0.0)
    before = s[1]
    s[1] = lag_after(drive, drive, before, p[1], c[STEP_S])
    s[2] = lag_after(before, s[1], s[2], p[2], c[STEP_S])
    return p[0] * c[LARGEST_NM] * s[2]


@mechanism(
    "axons whose own pump hyperpolarises them the more they fire: Vagg and others 1998, Kiernan and others 2004",
    "fatigue threshold_drift",
    "width that acts",
    **_muscle,
    half_at_us_share=(0.3, 0.8),
    spread_us=(12.0, 35.0),
    rises=(0.3, 0.8),
    tires_s=(1.5, 6.0),
    rests_s=(5.0, 40.0),
)
def axon_pump(x, p, s, c):
    """p: scale, τ s twice, width at half µs, spread µs, rise of a threshold, tires s, rests s.

    s: two lags; s[10:34]: the pump of each of 24 groups of axons.
    """
    count, drive, width = 24, 0.0, c[WIDTH_US]
    for k in range(count):
        rank = (k + 0.5) / count
        needs = max(p[3] + p[4] * math.log(rank / (1.0 - rank)), 15.0) * (1.0 + p[5] * s[10 + k])
        fires = 1.0 / (1.0 + math.exp(-min(max((width - needs) / 2.0, -60.0), 60.0))) if width > 0.0 else 0.0
        s[10 + k] += c[STEP_S] * (fires * (1.0 - s[10 + k]) / p[6] - (1.0 - fires) * s[10 + k] / p[7])
        drive += fires / count
    return p[0] * c[LARGEST_NM] * two_lags(drive, p, s, c)


@mechanism(
    "forearm and splint swing on pads that are soft until they are pressed, between joints that slip: Iwan 1966",
    "series_compliance",
    "rate of the second lag, torque at the cell",
    first_s=(0.02, 0.06),
    second_s=(0.04, 0.12),
    swings_hz=(2.5, 6.0),
    soft=(0.15, 0.5),
    pressed_at=(0.2, 0.8),
    slips=(0.05, 0.3),
    slips_at=(0.02, 0.2),
    zeta=(0.08, 0.3),
)
def swinging_splint(x, p, s, c):
    """p: scale, τ s twice, Hz where pressed, stiffness before, travel that presses, joints' share, slip at, damping.

    s: two lags, travel, its speed; s[10:18]: where each of 8 joints has slipped to.
    """
    torque = two_lags(x / c[LARGEST_NM], p, s, c)
    omega, step, splint_torque = 2.0 * math.pi * p[3], 0.125 * c[STEP_S], 0.0
    for _ in range(8):
        splint_torque = p[4] * s[2] + (1.0 - p[4]) * max(s[2] - p[5], 0.0)
        for k in range(8):
            reach = p[7] * (k + 1.0) / 8.0
            s[10 + k] = min(max(s[10 + k], s[2] - reach), s[2] + reach)
            splint_torque += p[6] / 8.0 * (s[2] - s[10 + k]) / p[7]
        splint_torque += 2.0 * p[8] / omega * s[3]
        s[3] += step * omega * omega * (torque - splint_torque)
        s[2] += step * s[3]
    return p[0] * c[LARGEST_NM] * splint_torque


PLACES = by_name(central_plateau, moving_electrode, dry_cushion, worn_reflex, axon_pump, swinging_splint)

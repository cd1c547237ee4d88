"""Muscles of physics kept from whoever tunes the diagnosis; only a seed of the set `sealed` draws them.

Their names tell nothing, on purpose. Don't read this while working on `identify`. `kept_c` and those after it came
later: a seed's kind, and so every figure of the set, differs from those measured before.
"""

from __future__ import annotations

import math

from stimrig.hardware_sim.hidden.base import delayed, lag_after
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, PULSE, STEP_S, WIDTH_US
from stimrig.hardware_sim.hidden.mechanism import mechanism


@mechanism(
    "a chain of sarcomeres of unequal strength on their length-tension curve: Morgan 1990, Campbell 2009",
    "asymmetric_relaxation series_compliance potentiation",
    "rate of rise, rate of fall",
    "activation, torque, sum of the past",
    activation_s=(0.03, 0.09),
    unequal=(0.05, 0.25),
    fastest_per_s=(0.5, 3.0),
    compliance=(0.05, 0.25),
    curved=(1.0, 6.0),
    passive=(0.5, 3.0),
)
def kept_a(x, p, s, c):
    """p: scale, activation s, spread of strength, lengths/s, spring's stretch, curve of length-tension, passive.

    s: two lags, 9 lengths beyond the optimum from s[10]. Total length and the spring's stretch add to a constant.
    """
    count = 9
    before = s[0]
    s[0] = lag_after(x / c[LARGEST_NM], x / c[LARGEST_NM], before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[1], c[STEP_S])
    force = 0.0
    for _ in range(6):
        shortened = 0.0
        for k in range(count):
            shortened -= s[10 + k] / count
        force = max(shortened / p[4], 0.0)
        for k in range(count):
            own = 1.0 + p[2] * (2.0 * k / (count - 1.0) - 1.0)
            length = s[10 + k]
            active = own * s[1] * max(1.0 - p[5] * length * length, 0.05)
            stretched = p[6] * length * abs(length)
            speed = (force - active - stretched) / (active + 0.15)
            s[10 + k] += c[STEP_S] / 6.0 * p[3] * min(max(speed, -1.0), 1.0)
    return p[0] * c[LARGEST_NM] * force


@mechanism(
    "phosphate and potassium of a closed space, washed out by flow that force itself stops; Dutka and Lamb 2004",
    "fatigue asymmetric_relaxation activation_dependent_speed",
    "drive, rate of rise, rate of fall",
    "activation, torque, sum of the past",
    rise_s=(0.03, 0.1),
    force_s=(0.06, 0.3),
    heaps_s=(3.0, 15.0),
    washed_s=(5.0, 25.0),
    lost=(0.3, 0.9),
    block=(0.1, 1.2),
    stops=(0.3, 0.9),
    block_s=(0.5, 3.0),
)
def kept_b(x, p, s, c):
    """p: scale, activation s, force s, heaps up s, washed out s, force lost, block of weak pulses, flow, block s.

    s: activation, force, phosphate, potassium.
    """
    drive = x / c[LARGEST_NM]
    if c[PULSE] > 0.0:
        s[3] += (1.0 - s[3]) * min(0.025 / p[8], 1.0)
    s[3] *= math.exp(-c[STEP_S] / (4.0 * p[8]))
    drive = drive ** (1.0 + p[6] * s[3])
    s[0] = lag_after(drive, drive, s[0], p[1], c[STEP_S])
    flow = 1.0 / (1.0 + (s[1] / p[7]) ** 4)
    s[2] += c[STEP_S] * (s[1] * (1.0 - s[2]) / p[3] - flow * s[2] / p[4])
    target = s[0] * (1.0 - p[5] * s[2] * s[2])
    tau = p[2] * (1.0 + 1.5 * s[2]) * (1.0 - 0.5 * s[0])
    s[1] += (target - s[1]) * (1.0 - math.exp(-c[STEP_S] / tau))
    return p[0] * c[LARGEST_NM] * max(s[1], 0.0)


@mechanism(
    "a reflex beside the direct way, worn by each pulse and held down by tension, late: Crone and Nielsen 1989 and Ib",
    "catch_like asymmetric_relaxation",
    "drive",
    "torque, time since",
    first_s=(0.03, 0.08),
    second_s=(0.06, 0.2),
    reflex=(0.6, 2.0),
    worn=(0.03, 0.15),
    rests_s=(0.5, 3.0),
    held_down=(0.5, 2.0),
    late_s=(0.04, 0.15),
)
def kept_c(x, p, s, c):
    """p: scale, τ s twice, reflex's size, worn by a pulse, rests s, held down by tension, late s.

    s: place in a ring, two lags, wear; s[100:612]: the ring. The reflex is largest where half of the axons answer.
    """
    own = min(max(x / c[LARGEST_NM], 0.0), 1.0)
    if c[PULSE] > 0.0:
        s[3] += p[4] * (1.0 - s[3])
    s[3] *= math.exp(-c[STEP_S] / p[5])
    felt = delayed(s[2], p[7] / c[STEP_S], s, 100, 512)
    drive = own + p[3] * own * (1.0 - own) * (1.0 - s[3]) * max(1.0 - p[6] * felt, 0.0)
    before = s[1]
    s[1] = lag_after(drive, drive, before, p[1], c[STEP_S])
    s[2] = lag_after(before, s[1], s[2], p[2], c[STEP_S])
    return p[0] * c[LARGEST_NM] * s[2]


@mechanism(
    "axons whose own pump hyperpolarises them the more they fire: Vagg and others 1998, Kiernan and others 2004",
    "fatigue threshold_drift",
    "drive",
    "width, sum of the past",
    first_s=(0.03, 0.08),
    second_s=(0.08, 0.25),
    half_at_us_share=(0.3, 0.8),
    spread_us=(12.0, 35.0),
    rises=(0.3, 0.8),
    tires_s=(1.5, 6.0),
    rests_s=(5.0, 40.0),
)
def kept_d(x, p, s, c):
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
    before = s[0]
    s[0] = lag_after(drive, drive, before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[2], c[STEP_S])
    return p[0] * c[LARGEST_NM] * s[1]


@mechanism(
    "forearm and splint swing on pads that are soft until they are pressed, between joints that slip: Iwan 1966",
    "series_compliance",
    "rate of rise, rate of fall, output",
    "torque",
    first_s=(0.02, 0.06),
    second_s=(0.04, 0.12),
    swings_hz=(2.5, 6.0),
    soft=(0.15, 0.5),
    pressed_at=(0.2, 0.8),
    slips=(0.05, 0.3),
    slips_at=(0.02, 0.2),
    zeta=(0.08, 0.3),
)
def kept_e(x, p, s, c):
    """p: scale, τ s twice, Hz where pressed, stiffness before, travel that presses, joints' share, slip at, damping.

    s: two lags, travel, its speed; s[10:18]: where each of 8 joints has slipped to.
    """
    before = s[0]
    s[0] = lag_after(x / c[LARGEST_NM], x / c[LARGEST_NM], before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[2], c[STEP_S])
    omega, step, held = 2.0 * math.pi * p[3], 0.125 * c[STEP_S], 0.0
    for _ in range(8):
        held = p[4] * s[2] + (1.0 - p[4]) * max(s[2] - p[5], 0.0)
        for k in range(8):
            reach = p[7] * (k + 1.0) / 8.0
            s[10 + k] = min(max(s[10 + k], s[2] - reach), s[2] + reach)
            held += p[6] / 8.0 * (s[2] - s[10 + k]) / p[7]
        held += 2.0 * p[8] / omega * s[3]
        s[3] += step * omega * omega * (s[1] - held)
        s[2] += step * s[3]
    return p[0] * c[LARGEST_NM] * held


SEALED = {"kept_a": kept_a, "kept_b": kept_b, "kept_c": kept_c, "kept_d": kept_d, "kept_e": kept_e}

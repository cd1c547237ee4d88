"""Muscles of physics kept from whoever tunes the diagnosis; only a seed of the set `sealed` draws them.

Their names tell nothing, on purpose. Don't read this while working on `identify`. They are others than those that had
these names until November 2026, which are open now (`physics`, `physics_places`): figures of the two don't compare.

kept_a: endplates whose stores run down and whose release grows by use (Elmqvist and Quastel 1965, J Physiol 178:505;
Magleby and Zengel 1982, J Gen Physiol 80:613), each with its own safety factor (Wood and Slater 2001, Prog Neurobiol
64:393). kept_b: filaments that shortening under load deforms (Maréchal and Plaghki 1979, J Gen Physiol 73:453), by
work as in McGowan, Neptune and Herzog 2010 (J Biomech 43:449). kept_c: a joint that torque stiffens and damps
(Hunter and Kearney 1982, J Biomech 15:747), by bridges that let go (Rack and Westbury 1974, J Physiol 240:331).
kept_d: myosin that rests off the filament until force calls it (Linari and others 2015, Nature 528:276; Campbell,
Janssen and Campbell 2018, Biophys J 115:525).
"""

from __future__ import annotations

import math

from bench.muscles.mechanism import mechanism
from stimrig.hardware_sim.hidden.base import lag_after
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, PULSE, STEP_S, WIDTH_US


@mechanism(
    "endplates that run down, and release more by use: Elmqvist and Quastel 1965; Magleby and Zengel 1982",
    "fatigue catch_like potentiation",
    "drive",
    "time since, sum of the past",
    first_s=(0.03, 0.08),
    second_s=(0.08, 0.25),
    half_at_us_share=(0.3, 0.8),
    spread_us=(12.0, 35.0),
    released=(0.02, 0.05),
    refills_s=(1.0, 3.0),
    safety=(1.7, 3.0),
    unequal=(0.15, 0.35),
    augments=(0.5, 2.0),
    augmented_s=(3.0, 9.0),
)
def kept_a(x, p, s, c):
    """p: scale, τ s twice, width at half µs, spread µs, released by a pulse, refills s, safety, spread, augments, s.

    s: two lags; s[10:34] what the stores of each of 24 groups of axons lack, s[40:64] how far their release has grown,
    s[70:94] the share of their fibres that answered the last pulse.
    """
    count, drive, width = 24, 0.0, c[WIDTH_US]
    for k in range(count):
        rank = (k + 0.5) / count
        needs = max(p[3] + p[4] * math.log(rank / (1.0 - rank)), 15.0)
        fires = 1.0 / (1.0 + math.exp(-min(max((width - needs) / 2.0, -60.0), 60.0))) if width > 0.0 else 0.0
        s[10 + k] *= math.exp(-c[STEP_S] / p[6])
        s[40 + k] *= math.exp(-c[STEP_S] / p[10])
        if c[PULSE] > 0.0:
            grown = 1.0 + p[9] * s[40 + k]
            potential = max((1.0 - s[10 + k]) * grown * p[7], 1e-6)
            s[70 + k] = 1.0 / (1.0 + potential ** (-1.0 / p[8]))
            s[10 + k] += fires * min(p[5] * grown, 1.0) * (1.0 - s[10 + k])
            s[40 + k] += fires * 0.02 * (1.0 - s[40 + k])
        drive += fires * s[70 + k] / count
    before = s[0]
    s[0] = lag_after(drive, drive, before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[2], c[STEP_S])
    return p[0] * c[LARGEST_NM] * s[1]


@mechanism(
    "filaments that shortening under load deforms: Maréchal and Plaghki 1979; McGowan, Neptune and Herzog 2010",
    "fatigue asymmetric_relaxation",
    "output",
    "torque, sum of the past",
    first_s=(0.03, 0.08),
    second_s=(0.08, 0.25),
    by_work=(1.2, 4.0),
    given_back=(0.03, 0.3),
    builds_s=(0.02, 0.1),
    let_go_at=(0.05, 0.25),
    let_go_s=(0.1, 0.6),
    lasts_s=(10.0, 40.0),
)
def kept_b(x, p, s, c):
    """p: scale, τ s twice, depression by work, share given back, builds up s, torque that lets go, let go s, lasts s.

    s: two lags, torque, work stored, depression. The tendon stretches in proportion to torque, so that shortens the
    muscle, and what the muscle works on it deforms its filaments until torque is gone.
    """
    drive = x / c[LARGEST_NM]
    before = s[0]
    s[0] = lag_after(drive, drive, before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[2], c[STEP_S])
    torque = s[1] * (1.0 - s[4])
    shortens = torque - s[2]
    s[2] = torque
    s[3] = max(s[3] + torque * shortens * (1.0 if shortens > 0.0 else p[4]), 0.0)
    s[3] *= math.exp(-c[STEP_S] * (1.0 / p[8] + 1.0 / (p[7] * (1.0 + (torque / p[6]) ** 4))))
    s[4] += (1.0 - math.exp(-p[3] * s[3]) - s[4]) * (1.0 - math.exp(-c[STEP_S] / p[5]))
    return p[0] * c[LARGEST_NM] * torque


@mechanism(
    "a joint that torque stiffens and damps, by bridges that let go: Hunter and Kearney 1982; Rack and Westbury 1974",
    "series_compliance activation_dependent_speed",
    "rate of rise, rate of fall, output",
    "torque",
    first_s=(0.02, 0.06),
    second_s=(0.04, 0.12),
    swings_hz=(2.0, 5.0),
    zeta=(0.12, 0.4),
    stiffens=(0.5, 4.0),
    lets_go_s=(0.06, 0.4),
    damps=(0.2, 1.0),
)
def kept_c(x, p, s, c):
    """p: scale, τ s twice, Hz at rest, damping at rest, stiffness by torque, bridges let go s, damping by torque.

    s: two lags, angle, its speed, where bridges hold. The cell feels the splint: a spring of 1 and its damping.
    """
    drive = x / c[LARGEST_NM]
    before = s[0]
    s[0] = lag_after(drive, drive, before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[2], c[STEP_S])
    omega, step, splint = 2.0 * math.pi * p[3], 0.125 * c[STEP_S], 0.0
    for _ in range(8):
        splint = s[2] + 2.0 * p[4] / omega * s[3]
        bridges = p[5] * s[1] * (s[2] - s[4]) + 2.0 * p[7] * math.sqrt(s[1]) / omega * s[3]
        s[3] += step * omega * omega * (s[1] - splint - bridges)
        s[2] += step * s[3]
        s[4] += step * (s[2] - s[4]) / p[6]
    return p[0] * c[LARGEST_NM] * splint


@mechanism(
    "myosin that rests off the filament until force calls it: Linari and others 2015; Campbell and others 2018",
    "potentiation activation_dependent_speed asymmetric_relaxation",
    "drive, rate of rise",
    "torque, sum of the past",
    activation_s=(0.02, 0.07),
    attach_per_s=(8.0, 25.0),
    detach_per_s=(5.0, 14.0),
    called_per_s=(0.25, 0.8),
    by_force=(8.0, 40.0),
    off_per_s=(0.4, 2.5),
)
def kept_d(x, p, s, c):
    """p: scale, activation s, attach and detach per s, called per s at rest, by how much more by force, off per s.

    s: two lags, bound share, what is on the filament beyond its share at rest.
    """
    drive = x / c[LARGEST_NM]
    before = s[0]
    s[0] = lag_after(drive, drive, before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[1], c[STEP_S])
    on = s[3] + p[4] / (p[4] + p[6])
    free = max(on - s[2], 0.0)
    s[3] += c[STEP_S] * (p[4] * (1.0 + p[5] * s[2]) * (1.0 - on) - p[6] * free)
    s[2] += c[STEP_S] * (p[2] * s[1] * free - p[3] * s[2])
    return p[0] * c[LARGEST_NM] * s[2]


SEALED = {"kept_a": kept_a, "kept_b": kept_b, "kept_c": kept_c, "kept_d": kept_d}

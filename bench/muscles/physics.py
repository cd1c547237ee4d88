"""Muscles of other physics than recruitment and second-order dynamics: whole mechanisms, not effects on a plain muscle.

`PHYSICS` are those of the yardstick, `FURTHER` come from elsewhere in the literature; `physics_places` has those of
other places than the muscle. Nothing here is fitted to a measured muscle: numbers lie about those of the papers, slowed
where a whole arm is slower than a fibre.
"""

from __future__ import annotations

import math
from typing import Any

from bench.muscles.mechanism import by_name, mechanism
from stimrig.hardware_sim.hidden.base import lag_after
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, PULSE, STEP_S, WIDTH_US, helper

_ding: Any = {
    "calcium_s": (0.011, 0.03),
    "sensitivity": (0.07, 0.3),
    "decay_s": (0.04, 0.12),
    "bridge_s": (0.04, 0.2),
    "doublet": (0.5, 1.5),
}


@helper
def calcium_of(p: Any, s: Any, c: Any) -> float:
    """Ding's bound calcium: p[1] τc, p[2] Km, p[5] R0 - 1 over that of the paper. s[0:2]: Cn, its release; s[2]: since.

    CN' = Σ R/τc - CN/τc, R = 1 + (R0 - 1) exp(-interval/τc), R0 = Km + 1.04, solved exactly between pulses.
    """
    s[2] += c[STEP_S]
    if c[PULSE] > 0.0:
        s[1] += 1.0 + p[5] * (p[2] + 0.04) * math.exp(-s[2] / p[1])
        s[2] = 0.0
    decay = math.exp(-c[STEP_S] / p[1])
    s[0] = decay * (s[0] + s[1] * c[STEP_S] / p[1])
    s[1] *= decay
    return s[0] / (p[2] + s[0])


@mechanism(
    "Ding, Wexler and Binder-Macleod 2003; recruitment 2007",
    "catch_like asymmetric_relaxation activation_dependent_speed",
    "strength, rate of the second lag",
    **_ding,
)
def ding(x, p, s, c):
    """p: scale, τc s, Km, τ1 s, τ2 s, doublet. s[3]: force, a share; s[4]: recruited by the last pulse."""
    bound = calcium_of(p, s, c)
    if c[PULSE] > 0.0:
        s[4] = x / c[LARGEST_NM]
    tau = p[3] + p[4] * bound
    s[3] += (s[4] * bound * tau - s[3]) * (1.0 - math.exp(-c[STEP_S] / tau))
    return p[0] * c[LARGEST_NM] * s[3]


@mechanism(
    "Ding, Wexler and Binder-Macleod 2003, with fatigue of A, τ1 and Km",
    "catch_like asymmetric_relaxation activation_dependent_speed fatigue",
    "strength, rate of the second lag",
    **_ding,
    loss=(0.25, 0.7),
    slowing=(0.1, 0.8),
    recovery_s=(15.0, 100.0),
)
def ding_fatigue(x, p, s, c):
    """As `ding`, and p: loss of A at full force held for 20 s, of which τ1 and Km follow by a share, recovery s.

    s[5]: what is lost. A' = -(A - A0)/τfat + αA F; likewise τ1 and Km.
    """
    rested_km = p[2]
    p[2] = rested_km * (1.0 + p[7] * s[5])
    bound = calcium_of(p, s, c)
    p[2] = rested_km
    if c[PULSE] > 0.0:
        s[4] = x / c[LARGEST_NM]
    tau = p[3] * (1.0 + p[7] * s[5]) + p[4] * bound
    s[3] += (s[4] * max(1.0 - s[5], 0.0) * bound * tau - s[3]) * (1.0 - math.exp(-c[STEP_S] / tau))
    s[5] += c[STEP_S] * (p[0] * s[3] * p[6] / 20.0 - s[5] / p[8])
    return p[0] * c[LARGEST_NM] * s[3]


@helper
def lengthening(tension: float, active: float, fastest: float, curved: float) -> float:
    """Hill's hyperbola as speed of shortening, lengths/s, negative where stretched (to 1.5 of the isometric force)."""
    q = (tension + 1e-3) / (active + 1e-3)  # at rest both are 0, and nothing moves
    if q <= 1.0:
        return fastest * (1.0 - q) / (1.0 + q / curved)
    return -fastest * min((q - 1.0) / max(1.5 - q, 0.02), 2.5)


@mechanism(
    "Hill 1938 with a series spring that stiffens; activation as in Winters and Thelen",
    "asymmetric_relaxation series_compliance activation_dependent_speed",
    "rate of the first lag, rate of the second lag",
    rise_s=(0.02, 0.08),
    fall_s=(0.05, 0.2),
    fastest_per_s=(1.0, 4.0),
    curved=(0.15, 0.45),
    stretch=(0.1, 0.4),
    toe=(0.5, 4.0),
)
def hill_series(x, p, s, c):
    """p: scale, activation rising s, falling s, vmax 1/s, a/F0, spring's stretch at full force, toe. s: a, stretch."""
    drive = x / c[LARGEST_NM]
    tau = p[1] * (0.5 + 1.5 * s[0]) if drive > s[0] else p[2] / (0.5 + 1.5 * s[0])
    s[0] += (drive - s[0]) * (1.0 - math.exp(-c[STEP_S] / tau))
    force = 0.0
    for _ in range(8):
        force = (math.exp(p[6] * s[1] / p[5]) - 1.0) / (math.exp(p[6]) - 1.0)
        s[1] = max(s[1] + 0.125 * c[STEP_S] * lengthening(force, s[0], p[3], p[4]), 0.0)
    return p[0] * c[LARGEST_NM] * force


@mechanism(
    "fast fibres that tire beside slow ones that hardly do, each with thresholds of its own; Burke 1973",
    "mixed_fibres fatigue",
    "",
    share=(0.35, 0.65),
    fast_s=(0.04, 0.09),
    slow_s=(0.15, 0.35),
    fast_at_us_share=(0.2, 0.7),
    slow_at_us_share=(0.4, 1.1),
    fast_loss=(0.5, 0.9),
    fast_tires_s=(4.0, 15.0),
    slow_loss=(0.05, 0.25),
    recovery_s=(10.0, 60.0),
    spread_us=(8.0, 30.0),
)
def two_populations(x, p, s, c):
    """p: scale, fast share, τ s of either, width at half of either µs, loss fast, tires s, slow, recovers s, spread µs.

    s: two lags of the fast, two of the slow, what is lost of either.
    """
    force = 0.0
    for k in range(2):
        drive = 0.0
        if c[WIDTH_US] > 0.0:
            drive = 1.0 / (1.0 + math.exp(-(c[WIDTH_US] - p[4 + k]) / p[10]))
        loss = p[6] if k == 0 else p[8]
        s[4 + k] += c[STEP_S] * (drive * (loss - s[4 + k]) / p[7] - (1.0 - drive) * s[4 + k] / p[9])
        before = s[2 * k]
        s[2 * k] = lag_after(drive, drive, before, p[2 + k], c[STEP_S])
        s[2 * k + 1] = lag_after(before, s[2 * k], s[2 * k + 1], p[2 + k], c[STEP_S])
        force += (p[1] if k == 0 else 1.0 - p[1]) * (1.0 - s[4 + k]) * s[2 * k + 1]
    return p[0] * c[LARGEST_NM] * force


@mechanism(
    "Huxley 1957, bridges over their strain, against a series spring; activation by two lags",
    "asymmetric_relaxation series_compliance activation_dependent_speed",
    "rate of the second lag",
    activation_s=(0.02, 0.07),
    attach_per_s=(10.0, 40.0),
    detach_per_s=(6.0, 20.0),
    detach_behind_per_s=(40.0, 200.0),
    stretch_h=(2.0, 12.0),
)
def huxley(x, p, s, c):
    """p: scale, activation s, f1, g1, g2 per s, spring's stretch at full force in strains h.

    s: two lags, stretch; s[10:74]: bound share at strains from -1.5 to 1.5 h, carried by sliding, upwind.
    """
    before = s[0]
    s[0] = lag_after(x / c[LARGEST_NM], x / c[LARGEST_NM], before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[1], c[STEP_S])
    bins, width, step = 64, 3.0 / 64.0, 0.25 * c[STEP_S]
    force = 0.0
    for _ in range(4):
        force = s[2] / p[5]
        pull = 0.0
        for i in range(bins):
            pull += s[10 + i] * (-1.5 + (i + 0.5) * width) * width
        speed = min(max((2.0 * pull - force) * 300.0, -0.9 * width / step), 0.9 * width / step)
        s[2] += step * speed
        moved = step * speed / width
        last = 0.0
        for k in range(bins):
            i = k if speed < 0.0 else bins - 1 - k  # from where bridges come out first
            strain = -1.5 + (i + 0.5) * width
            attach = s[1] * p[2] * strain if 0.0 < strain < 1.0 else 0.0
            detach = p[3] * strain if strain > 0.0 else p[4]
            if strain > 1.0:
                detach += p[4] * (strain - 1.0)
            mine = s[10 + i]
            carried = mine + abs(moved) * (last - mine)
            last = mine
            s[10 + i] = carried + (attach - (attach + detach) * carried) * step / (1.0 + (attach + detach) * step)
    return p[0] * c[LARGEST_NM] * force


@mechanism(
    "a pool of 40 units, small ones slow: twitches that fuse by their own time, sag of the fast; Fuglevand 1993",
    "mixed_fibres catch_like asymmetric_relaxation",
    "",
    sizes=(5.0, 40.0),
    fastest_s=(0.03, 0.06),
    slower_by=(2.0, 4.0),
    fuses_at=(2.0, 6.0),
    sag=(0.05, 0.35),
    sag_s=(0.15, 0.6),
    order=(-1.0, 1.0),
)
def unit_pool(x, p, s, c):
    """p: scale, largest size, fastest s, slowest over it, twitches that fuse, sag, sag s, order.

    Currents take large units first where order < 0 and small ones where it is > 0, the less the nearer it is to 0.
    s[4k:4k+3]: two lags of a unit's pulses and its sag.
    """
    count, reached, total, force = 40, x / c[LARGEST_NM], 0.0, 0.0
    for k in range(count):
        small = k / (count - 1.0)  # 0: largest
        size = math.exp(-math.log(p[1]) * small)
        total += size
        mixed = ((17 * k + 5) % count + 0.5) / count
        weight = abs(p[7])
        place = weight * (small if p[7] < 0.0 else 1.0 - small) + (1.0 - weight) * mixed
        tau = p[2] * math.exp(math.log(p[3]) * small)
        if c[PULSE] > 0.0 and reached > place * 0.98:
            s[4 * k] += 1.0
            s[4 * k + 2] += (1.0 - s[4 * k + 2]) * min(0.025 / p[6], 1.0)
        decay = math.exp(-c[STEP_S] / tau)
        s[4 * k + 1] = decay * (s[4 * k + 1] + s[4 * k] * c[STEP_S] / tau * 2.718)
        s[4 * k] *= decay
        s[4 * k + 2] *= math.exp(-c[STEP_S] / (2.0 * p[6]))
        twitch = (s[4 * k + 1] / p[4]) ** 2
        force += size * twitch / (1.0 + twitch) * (1.0 - p[5] * (1.0 - small) * s[4 * k + 2])
    return p[0] * c[LARGEST_NM] * force / total


@mechanism(
    "a viscoelastic tendon that is slack at rest, behind a second-order muscle; Zajac 1989",
    "series_compliance electromechanical_delay asymmetric_relaxation",
    "rate of the second lag, torque at the cell",
    active_s=(0.04, 0.12),
    slack=(0.1, 0.6),
    stretch=(0.2, 0.8),
    toe=(1.5, 4.0),
    damping_s=(0.05, 0.3),
    tendon_s=(0.01, 0.08),
)
def slack_tendon(x, p, s, c):
    """p: scale, activation s, slack, stretch at full force, toe, muscle's damping s, tendon's s. s: lags, length."""
    before = s[0]
    s[0] = lag_after(x / c[LARGEST_NM], x / c[LARGEST_NM], before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[1], c[STEP_S])
    force = 0.0
    for _ in range(4):
        taut = max(s[2] - p[2], 0.0) / p[3]
        slope = p[4] * math.exp(p[4] * taut) / (math.exp(p[4]) - 1.0) / p[3] if taut > 0.0 else 0.0
        spring = (math.exp(p[4] * taut) - 1.0) / (math.exp(p[4]) - 1.0)
        # tendon: spring + its own viscosity; muscle: active less what it needs to shorten; 0.1: passive pull back
        speed = (s[1] - spring - 0.1 * s[2]) / (p[5] + p[6] * slope)
        s[2] = max(s[2] + 0.25 * c[STEP_S] * speed, 0.0)
        force = max(spring + p[6] * slope * speed, 0.0)
    return p[0] * c[LARGEST_NM] * force


@mechanism(
    "calcium bound by troponin and, slowly, by parvalbumin, which fills in a train; Baylor and Hollingworth 1998",
    "asymmetric_relaxation potentiation catch_like",
    "strength, rate of the first lag",
    pump_s=(0.008, 0.03),
    troponin_per_s=(60.0, 200.0),
    parvalbumin=(0.5, 3.0),
    parvalbumin_per_s=(5.0, 30.0),
    parvalbumin_off_s=(0.5, 4.0),
    half=(0.3, 0.8),
    force_s=(0.05, 0.15),
)
def two_buffers(x, p, s, c):
    """p: scale, pump s, troponin on and off per s, parvalbumin's size, on per s, off s, half activation, force s.

    s: calcium, bound to troponin, to parvalbumin, force, recruited by the last pulse.
    """
    if c[PULSE] > 0.0:
        s[0] += 1.0
        s[4] = x / c[LARGEST_NM]
    for _ in range(8):
        h = 0.125 * c[STEP_S]
        troponin = p[2] * (s[0] * (1.0 - s[1]) - 0.5 * s[1])
        parvalbumin = p[4] * (s[0] * (1.0 - s[2]) * 4.0) - s[2] / p[5]
        s[0] = max(s[0] + h * (-s[0] / p[1] - 0.3 * troponin - p[3] * parvalbumin), 0.0)
        s[1] += h * troponin
        s[2] += h * parvalbumin
    open_ = s[1] ** 3 / (s[1] ** 3 + p[6] ** 3)
    s[3] += (s[4] * open_ - s[3]) * (1.0 - math.exp(-c[STEP_S] / p[7]))
    return p[0] * c[LARGEST_NM] * s[3]


@mechanism(
    "bridges that hold the filament open: attachment grows with force, detachment falls; Campbell 1997",
    "activation_dependent_speed asymmetric_relaxation",
    "strength, rate of the second lag",
    activation_s=(0.02, 0.06),
    on_per_s=(3.0, 10.0),
    off_per_s=(8.0, 25.0),
    helps=(1.0, 6.0),
    holds=(0.3, 0.85),
)
def cooperative(x, p, s, c):
    """p: scale, activation s, attachment and detachment per s, by how much force helps the one and slows the other."""
    before = s[0]
    s[0] = lag_after(x / c[LARGEST_NM], x / c[LARGEST_NM], before, p[1], c[STEP_S])
    s[1] = lag_after(before, s[0], s[1], p[1], c[STEP_S])
    on = p[2] * s[1] * (1.0 + p[4] * s[2])
    off = p[3] * (1.0 - p[5] * min(s[2], 1.0))
    s[2] += (on / (on + off) - s[2]) * (1.0 - math.exp(-c[STEP_S] * (on + off)))
    return p[0] * c[LARGEST_NM] * s[2]


@mechanism(
    "a chain of sarcomeres of unequal strength on their length-tension curve: Morgan 1990, Campbell 2009",
    "asymmetric_relaxation series_compliance potentiation",
    "strength, rate of the second lag",
    activation_s=(0.03, 0.09),
    unequal=(0.05, 0.25),
    fastest_per_s=(0.5, 3.0),
    compliance=(0.05, 0.25),
    curved=(1.0, 6.0),
    passive=(0.5, 3.0),
)
def sarcomere_chain(x, p, s, c):
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
            strength = 1.0 + p[2] * (2.0 * k / (count - 1.0) - 1.0)
            length = s[10 + k]
            active = strength * s[1] * max(1.0 - p[5] * length * length, 0.05)
            stretched = p[6] * length * abs(length)
            speed = (force - active - stretched) / (active + 0.15)
            s[10 + k] += c[STEP_S] / 6.0 * p[3] * min(max(speed, -1.0), 1.0)
    return p[0] * c[LARGEST_NM] * force


@mechanism(
    "phosphate and potassium of a closed space, washed out by flow that force itself stops; Dutka and Lamb 2004",
    "fatigue asymmetric_relaxation activation_dependent_speed",
    "strength, rate of the second lag",
    rise_s=(0.03, 0.1),
    force_s=(0.06, 0.3),
    heaps_s=(3.0, 15.0),
    washed_s=(5.0, 25.0),
    lost=(0.3, 0.9),
    block=(0.1, 1.2),
    stops=(0.3, 0.9),
    block_s=(0.5, 3.0),
)
def closed_space(x, p, s, c):
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


PHYSICS = by_name(ding, ding_fatigue, hill_series, two_populations)
FURTHER = by_name(huxley, unit_pool, slack_tendon, two_buffers, cooperative, sarcomere_chain, closed_space)

"""Recruitment hysteresis: the same pulse width recruits less on the way up than on the way down."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base, look_up
from stimrig.hardware_sim.patients.hidden.kernels import ACTIVATION, LARGEST_NM, Formulation, Stage, kernel


@kernel("electrode")
def _bouc_wen(x, p, s, c):
    """p: amplitude µs, reach µs, β, γ, n. s: z, width before. z' = u' - β |u'| |z|^(n-1) z - γ u' |z|^n, over reach."""
    change = x - s[1]
    s[1] = x
    pieces = int(abs(change)) + 1
    d = change / pieces / p[1]
    for _ in range(pieces):
        size = abs(s[0])
        s[0] += d - p[2] * abs(d) * size ** (p[4] - 1.0) * s[0] - p[3] * d * size ** p[4]
    return max(x - p[0] * s[0], 0.0) if x > 0.0 else 0.0


@kernel("electrode")
def _preisach(x, p, s, c):
    """p: width of the plane µs, spread µs, then the relays' weights. s: relays, -1 or 1."""
    top, n = p[0], 20
    spacing = top / n
    shift = 0.0
    k = 0
    for i in range(n):
        up = (i + 0.5) * spacing
        for j in range(i + 1):
            down = j * spacing
            if x >= up:
                s[k] = 1.0
            elif x <= down:
                s[k] = 0.0
            shift += p[2 + k] * (s[k] - min(max((x - down) / (up - down), 0.0), 1.0))
            k += 1
    return max(x + p[1] * shift, 0.0) if x > 0.0 else 0.0


@kernel("recruitment")
def _unit_thresholds(x, p, s, c):
    """p[0:512]: torque at every µs; p[512:1024]: half-gap of each threshold, µs. s: width each threshold still feels.

    Every µs of the curve is a group of units with a higher threshold for joining than for leaving.
    """
    w = 0.0
    for i in range(511):
        step = p[i + 1] - p[i]
        if step != 0.0:
            half = p[512 + i]
            if x - half > s[i]:
                s[i] = x - half
            elif x + half < s[i]:
                s[i] = x + half
            w += step * min(max(s[i] - i, 0.0), 1.0)
    c[ACTIVATION] = w / c[LARGEST_NM]
    return w


@kernel("recruitment")
def _two_curves(x, p, s, c):
    """p[0:512]: torque at every µs; shift as a share of the width; reach µs. s: direction -1 to 1, width before."""
    s[0] = min(max(s[0] + (x - s[1]) / p[513], -1.0), 1.0)
    s[1] = x
    q = s[0] * (1.5 - 0.5 * s[0] * s[0])
    up, down = look_up(p, x * (1.0 - p[512])), look_up(p, x * (1.0 + p[512]))
    w = 0.5 * (1.0 + q) * up + 0.5 * (1.0 - q) * down
    c[ACTIVATION] = w / c[LARGEST_NM]
    return w


SIDE = 20


def bouc_wen(rng: Generator, _base: Base) -> Formulation:
    beta = float(rng.uniform(0.5, 0.9))
    n, reach = float(rng.choice([1.0, 1.5, 2.0])), float(rng.uniform(15.0, 40.0))
    return Formulation(
        "Bouc-Wen hysteresis of the pulse width",
        "Bouc 1967, Wen 1976; Ikhouane and Rodellar 2007",
        lambda m: [Stage(_bouc_wen, (m, reach, beta, 1.0 - beta, n))],
        40.0,
        "amplitude_us",
        {"reach_us": reach, "beta": beta, "n": n},
    )


def preisach(rng: Generator, base: Base) -> Formulation:
    top = float(base.largest_width_us)
    i, j = np.tril_indices(SIDE)
    gap = (i - j) * top / SIDE
    typical = float(rng.uniform(30.0, 80.0))
    weight = np.exp(-(((gap - typical) / (0.5 * typical)) ** 2)) * np.exp(rng.normal(0.0, 0.2, gap.size))
    weight /= weight.sum()
    return Formulation(
        "Preisach plane of relays",
        "Preisach 1935; Mayergoyz 1991",
        lambda m: [Stage(_preisach, (top, m, *weight))],
        60.0,
        "amplitude_us",
        {"typical_gap_us": typical},
    )


def unit_thresholds(rng: Generator, base: Base) -> Formulation:
    shape = np.exp(rng.normal(0.0, 0.4, 512))
    larger_above = float(rng.uniform(-0.5, 0.8))
    shape *= 1.0 + larger_above * np.linspace(-0.5, 0.5, 512)
    return Formulation(
        "motor units with separate thresholds for joining and leaving",
        "persistent inward currents, Heckman, Gorassini and Bennett 2005; Prandtl-Ishlinskii sum of play operators",
        lambda m: [Stage(_unit_thresholds, (*base.table_nm, *(m * shape)))],
        30.0,
        "half_gap_us",
        {"larger_at_higher_thresholds": larger_above},
    )


def two_curves(rng: Generator, base: Base) -> Formulation:
    reach = float(rng.uniform(20.0, 60.0))
    return Formulation(
        "a curve for rising and one for falling widths, blended",
        "two curves of ramp deconvolution, Durfee and MacLean 1989",
        lambda m: [Stage(_two_curves, (*base.table_nm, m, reach))],
        0.25,
        "shift_share",
        {"reach_us": reach},
    )


FORMULATIONS = (bouc_wen, preisach, unit_thresholds)
KEPT_BACK = (two_curves,)

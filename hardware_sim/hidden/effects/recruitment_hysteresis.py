"""Recruitment hysteresis: the same pulse width recruits less on the way up than on the way down."""

from __future__ import annotations

import numpy as np

from stimrig.hardware_sim.hidden.base import look_up
from stimrig.hardware_sim.hidden.forms import Effect, Numbers, draws, recruitment_table

EFFECT = Effect()


@EFFECT.form("Bouc-Wen hysteresis of the pulse width", "Bouc 1967, Wen 1976; Ikhouane and Rodellar 2007")
@draws("electrode", 40.0, "amplitude_us", beta=(0.5, 0.9), n=[1.0, 1.5, 2.0], reach_us=(15.0, 40.0))
def _bouc_wen(x, p, s, c):
    """p: amplitude µs, β, n, reach µs. s: z, width before.

    z' = u' - β |u'| |z|^(n-1) z - (1 - β) u' |z|^n, over reach.
    """
    change = x - s[1]
    s[1] = x
    pieces = int(abs(change)) + 1
    d = change / pieces / p[3]
    for _ in range(pieces):
        size = abs(s[0])
        s[0] += d - p[1] * abs(d) * size ** (p[2] - 1.0) * s[0] - (1.0 - p[1]) * d * size ** p[2]
    return max(x - p[0] * s[0], 0.0) if x > 0.0 else 0.0


SIDE = 20


def _plane(rng, base):
    top = float(base.largest_width_us)
    i, j = np.tril_indices(SIDE)
    gap = (i - j) * top / SIDE
    typical = float(rng.uniform(30.0, 80.0))
    weight = np.exp(-(((gap - typical) / (0.5 * typical)) ** 2)) * np.exp(rng.normal(0.0, 0.2, gap.size))
    weight /= weight.sum()
    return Numbers((top, *weight), typical_gap_us=typical)


@EFFECT.form("Preisach plane of relays", "Preisach 1935; Mayergoyz 1991")
@draws("electrode", 60.0, "amplitude_us", _plane=_plane)
def _preisach(x, p, s, c):
    """p: spread µs, width of the plane µs, then the relays' weights. s: relays, 0 or 1."""
    top, n = p[1], 20
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
    return max(x + p[0] * shift, 0.0) if x > 0.0 else 0.0


def _half_gaps(rng, _base):
    shape = np.exp(rng.normal(0.0, 0.4, 512))
    larger_above = float(rng.uniform(-0.5, 0.8))
    shape *= 1.0 + larger_above * np.linspace(-0.5, 0.5, 512)
    return Numbers(shape, larger_at_higher_thresholds=larger_above)


@EFFECT.form(
    "motor units with separate thresholds for joining and leaving",
    "persistent inward currents, Heckman, Gorassini and Bennett 2005; Prandtl-Ishlinskii sum of play operators",
)
@draws(
    "recruitment",
    30.0,
    "half_gap_us",
    arrange=lambda m, *numbers: (*numbers[:512], *(m * shape for shape in numbers[512:])),
    _table=recruitment_table,
    _half_gaps=_half_gaps,
)
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
    return w


@EFFECT.held_back(
    "a curve for rising and one for falling widths, blended",
    "two curves of ramp deconvolution, Durfee and MacLean 1989",
)
@draws(
    "recruitment",
    0.25,
    "shift_share",
    arrange=lambda m, *numbers: (*numbers[:512], m, numbers[512]),
    _table=recruitment_table,
    reach_us=(20.0, 60.0),
)
def _two_curves(x, p, s, c):
    """p[0:512]: torque at every µs; shift as a share of the width; reach µs. s: direction -1 to 1, width before."""
    s[0] = min(max(s[0] + (x - s[1]) / p[513], -1.0), 1.0)
    s[1] = x
    q = s[0] * (1.5 - 0.5 * s[0] * s[0])
    up, down = look_up(p, x * (1.0 - p[512])), look_up(p, x * (1.0 + p[512]))
    return 0.5 * (1.0 + q) * up + 0.5 * (1.0 - q) * down

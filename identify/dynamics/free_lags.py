"""Two lags in a row whose rates are free functions of the state; compiled.

a' = k1 (w - a + κ (a - y)), y' = k2 (a - y): a follows the drive w, the torque y follows a. With constant rates this is
T² y'' + 2 ζ T y' + y = w, where T² = 1/(k1 k2) and 2 ζ T = 1/k1 + (1 - κ)/k2. Before them the drive passes a gate that
pulses open, and a gain that a slow state changes. All is exact for rates that are held over a third of an interval.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit

from stimrig.identify.dynamics.second_order import step_matrix

PARTS = 3
"""Steps within a pulse interval in which the rates are evaluated."""
EDGE = 0.02
"""Share of the largest torque over which rising turns into falling."""
LEAST_PRESENT = 0.05
"""A pulse that acts for a smaller share of an interval gives no width."""
LOW = 0.25
"""Share of the largest torque that is added to a level before its logarithm is taken."""
STEEPEST = 3.0
"""Largest logarithm of a factor on a rate."""


class FreeLaw(IntEnum):
    """Columns of the kernel's table of free laws; each is neutral at 0. Levels are shares of y_max."""

    FIRST_DIRECTION = 0  # log rate of the first lag while rising, less that while falling
    FIRST_RISING = 1  # power of the level (a + 1/4) of the first lag's rate, while rising
    FIRST_FALLING = 2  # while falling
    SECOND_DIRECTION = 3  # as above, of the second lag, by y
    SECOND_RISING = 4
    SECOND_FALLING = 5
    COUPLING = 6  # κ, beyond that of a damping below 1
    FILL_S = 7  # time constant in which the slow state fills; 0: there is none
    EMPTY_S = 8  # in which it recovers
    GAIN = 9  # change of the drive by the full slow state, as a share
    RATE = 10  # log rate of both lags by it
    ZERO = 11  # torque that it adds, as a share of y_max
    GATE_S = 12  # time constant of the gate's two lags; 0: there is none
    BEND = 13  # its saturation: open by (1 + bend) c/(1 + bend c)
    GATE_RATE = 14  # log rate of both lags by the open gate
    FEEDBACK = 15  # change of the drive by full torque, as a share
    BY_PULSES = 16  # 1: pulses fill the slow state; else the torque does
    BY_DRIVE = 17  # 1: the drive fills it
    SWAPPED = 18  # 1: the slower lag is the first


@njit(cache=True, nogil=True)
def _log_rate(direction, rising, falling, gap, level):  # pragma: no cover
    up = 0.5 * (1.0 + gap / np.sqrt(1.0 + gap * gap))
    power = rising * up + falling * (1.0 - up)
    return direction * (up - 0.5) + power * np.log((min(max(level, 0.0), 2.0) + LOW) / (1.0 + LOW))


@njit(cache=True, nogil=True)
def lag_s(base_s, log_rate):  # pragma: no cover
    """A time constant, s, at a logarithm of its rate's factor."""
    return base_s * np.exp(-min(max(log_rate, -STEEPEST), STEEPEST))


@njit(cache=True, nogil=True)
def filled(state, up, down, step_s):  # pragma: no cover
    """A slow state after a step: s' = up (1 - s) - down s, exact for held rates, 1/s; as it was where both are 0."""
    rate = up + down
    if not rate > 0.0:
        return state
    goal = up / rate
    return goal + (state - goal) * np.exp(-rate * step_s)


@njit(cache=True, nogil=True)
def run_free(drive, on, rest_s, core, law, begins, initial, scale_nm, step_s):  # pragma: no cover
    """Boundary states of rows of drives, torque, N·m, and its rate, each of shape (M, K + 1).

    `drive`, (M, K), is the mean of each interval, `on`, (K,), the share of it in which a pulse acts, `rest_s`, (K,),
    additional rest before an interval; `core`, (M, 2), holds T, s, and ζ, `law`, (M, len(FreeLaw)), what is free.
    `begins`, `initial`, `scale_nm` and `step_s` are as in `run_core`.

    Rows that differ from row 0 in their drive alone use its transitions, as in `run_core`.
    """
    rows, size = drive.shape
    torque, rate = np.zeros((rows, size + 1)), np.zeros((rows, size + 1))
    transitions = np.empty(
        (size, 8)
    )  # of row 0: (y, a) after each interval by (y, a) before and the drive, second lag, zero
    h = step_s / PARTS
    for m in range(rows):
        p = law[m]
        same_law = m > 0 and np.all(core[m] == core[0]) and np.all(p == law[0])
        root = np.sqrt(max(core[m, 1] * core[m, 1] - 1.0, 0.0))
        first_s = core[m, 0] * (max(core[m, 1], 1.0) - root)
        second_s = core[m, 0] * (max(core[m, 1], 1.0) + root)
        if p[FreeLaw.SWAPPED] > 0.5:
            first_s, second_s = second_s, first_s
        coupling = p[FreeLaw.COUPLING] + 2.0 * max(1.0 - core[m, 1], 0.0)
        gated, slow = p[FreeLaw.GATE_S] > 0.0, p[FreeLaw.FILL_S] > 0.0
        decay = np.exp(-h / p[FreeLaw.GATE_S]) if gated else 0.0
        first = p[FreeLaw.FIRST_DIRECTION], p[FreeLaw.FIRST_RISING], p[FreeLaw.FIRST_FALLING]
        second = p[FreeLaw.SECOND_DIRECTION], p[FreeLaw.SECOND_RISING], p[FreeLaw.SECOND_FALLING]
        bent = np.any(p[: FreeLaw.COUPLING] != 0.0)  # all laws of level and direction stand before it
        part, y, a, s, c1, c2, last = 0, 0.0, 0.0, 0.0, 0.0, 0.0, -1
        one_s, two_s, edge = 0.0, 0.0, EDGE * scale_nm
        b11, b12, b21, b22, b1, b2 = 1.0, 0.0, 0.0, 1.0, 0.0, 0.0
        for k in range(size):
            if part < begins.size and k == begins[part]:
                y = initial[m, part, 0]
                a = y + initial[m, part, 1] * second_s
                torque[m, k], rate[m, k] = y, initial[m, part, 1]
                part += 1
            if on[k] > LEAST_PRESENT or not gated:
                last = k
            w = drive[m, last] if last >= 0 else 0.0
            if gated and last >= 0:
                w /= on[last]
            if same_law:
                y, a = (
                    transitions[k, 0] * y + transitions[k, 1] * a + transitions[k, 4] * w,
                    transitions[k, 2] * y + transitions[k, 3] * a + transitions[k, 5] * w,
                )
                torque[m, k + 1], rate[m, k + 1] = y + transitions[k, 7], (a - y) / transitions[k, 6]
                continue
            strength, quick = 1.0, 0.0
            if slow:
                if rest_s[k] > 0.0:
                    s *= np.exp(-rest_s[k] / p[FreeLaw.EMPTY_S])
                work = w if p[FreeLaw.BY_DRIVE] > 0.5 else y
                work = on[k] if p[FreeLaw.BY_PULSES] > 0.5 else min(max(work / scale_nm, 0.0), 1.0)
                s = filled(s, work / p[FreeLaw.FILL_S], (1.0 - work) / p[FreeLaw.EMPTY_S], step_s)
                strength, quick = max(1.0 + p[FreeLaw.GAIN] * s, 0.0), p[FreeLaw.RATE] * s
            if p[FreeLaw.FEEDBACK] != 0.0:
                strength *= max(1.0 + p[FreeLaw.FEEDBACK] * min(max(y / scale_nm, 0.0), 2.0), 0.0)
            yy, ya, ay, aa, yw, aw = 1.0, 0.0, 0.0, 1.0, 0.0, 0.0
            for _ in range(PARTS):
                share, log_rate = strength, quick
                if gated:
                    before = c1
                    c1 = on[k] + (c1 - on[k]) * decay
                    c2 = 0.5 * (before + c1) + (c2 - 0.5 * (before + c1)) * decay
                    gate = (1.0 + p[FreeLaw.BEND]) * c2 / (1.0 + p[FreeLaw.BEND] * c2)
                    share, log_rate = share * gate, log_rate + p[FreeLaw.GATE_RATE] * gate
                x = share * w
                log_one, log_two = log_rate, log_rate
                if bent:
                    log_one += _log_rate(*first, (x - a) / edge, a / scale_nm)
                    log_two += _log_rate(*second, (a - y) / edge, y / scale_nm)
                new_one_s, new_two_s = lag_s(first_s, log_one), lag_s(second_s, log_two)
                if new_one_s != one_s or new_two_s != two_s:  # else the step is the one before
                    one_s, two_s = new_one_s, new_two_s
                    t = np.sqrt(one_s * two_s)
                    q11, q12, q21, q22 = step_matrix(t, max(0.5 * (one_s + (1.0 - coupling) * two_s) / t, 0.05), h)
                    # from (y - x, (a - y)/two) to (y, a), both as linear functions of (y, a, x)
                    b11, b12, b1 = q11 - q12 / two_s, q12 / two_s, 1.0 - q11
                    b21, b22 = b11 + two_s * q21 - q22, b12 + q22
                    b2 = b1 - two_s * q21
                y, a = b11 * y + b12 * a + b1 * x, b21 * y + b22 * a + b2 * x
                if m == 0:
                    yy, ya, yw, ay, aa, aw = (
                        b11 * yy + b12 * ay,
                        b11 * ya + b12 * aa,
                        b11 * yw + b12 * aw + b1 * share,
                        b21 * yy + b22 * ay,
                        b21 * ya + b22 * aa,
                        b21 * yw + b22 * aw + b2 * share,
                    )
            if m == 0:
                transitions[k, 0], transitions[k, 1], transitions[k, 2], transitions[k, 3] = yy, ya, ay, aa
                transitions[k, 4], transitions[k, 5], transitions[k, 6], transitions[k, 7] = (
                    yw,
                    aw,
                    two_s,
                    p[FreeLaw.ZERO] * s * scale_nm,
                )
            torque[m, k + 1], rate[m, k + 1] = y + p[FreeLaw.ZERO] * s * scale_nm, (a - y) / two_s
    return torque, rate

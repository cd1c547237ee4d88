"""Second-order muscle dynamics whose speed depends on the state; compiled.

T² y'' + 2 ζ T y' + y = w, with w held over each pulse interval. A speed law multiplies T, or one of the two lags, by a
factor that depends on the state. Without a law the transition of the linear dynamics is used, bit for bit.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit

from stimrig.identify.dynamics.states import step_matrix, through

PARTS = 3
"""Number of steps within a pulse interval in which a speed law is evaluated."""


class SpeedLaw(IntEnum):
    """What the speed depends on: each law is a column of the kernel's table, and is neutral at 0.

    T is the time constant; y the torque, w the drive, a the state between the two lags, all as shares of y_max.
    """

    RATIO_BY_DRIVE = 0
    """T: log ratio while the drive is below the torque"""
    RATIO_BY_RATE = 1
    """T: log ratio while the torque falls"""
    TORQUE = 2
    """T: linear in torque"""
    DRIVE = 3
    """T: linear in drive"""
    EXPONENTIAL = 4
    """T: exponential in torque"""
    INVERSE_TORQUE = 5
    """T: inverse linear in torque"""
    INVERSE_DRIVE = 6
    """T: inverse linear in drive"""
    SLOW_TORQUE = 7
    """slower lag: linear in torque"""
    SLOW_RATIO_BY_DRIVE = 8
    """slower lag: log ratio while the drive is below the torque"""
    SLOW_INVERSE_DRIVE = 9
    """slower lag: inverse linear in drive"""
    ACTIVATION = 10
    """T: linear in activation, the state between the two lags"""
    LEVEL = 11
    """T: power of 0.5 + 1.5 y/y_max; slower to rise and quicker to fall at high levels"""
    SLOW_SATURATING_DRIVE = 12
    """slower lag: linear in a drive that saturates"""
    QUICK_RATIO_BY_RATE = 13
    """quicker lag: log ratio while the torque falls"""
    QUICK_RATIO_BY_DRIVE = 14
    """quicker lag: log ratio while the drive is below the torque"""
    SLOW_RATIO_BY_RATE = 15
    """slower lag: log ratio while the torque falls"""
    SLOW_CALCIUM = 16
    """slower lag: linear in bound calcium, which follows with the quicker lag whether there is drive"""
    QUICK_CALCIUM = 17
    """quicker lag: linear in bound calcium, which follows with the slower lag"""
    SLOW_LEVEL = 18
    """slower lag: as LEVEL"""
    SLOW_SECOND_ACTIVATION = 19
    """two lags in a row, the slower one second: linear in its input a"""
    SLOW_SECOND_ATTACHED = 20
    """the same: inverse linear in torque"""
    QUICK_SECOND_ACTIVATION = 21
    """two lags in a row, the quicker one second: linear in its input a"""
    QUICK_SECOND_ATTACHED = 22
    """the same: inverse linear in torque"""
    SLOW_PUMP = 23
    """two lags in a row, the slower one first: a pump that saturates, linear in a and in drive"""
    QUICK_PUMP = 24
    """the same with the quicker one first"""


@njit(cache=True, nogil=True)
def _uptake(slope, w, a):  # pragma: no cover
    """Factor on the lag of a saturating uptake, where w/(1 + s w) - a/(1 + s a) drives a towards w."""
    w, a = min(max(w, 0.0), 1.2), min(max(a, 0.0), 1.2)
    return max(1.0 + slope * w, 0.08) * max(1.0 + slope * a, 0.08)


@njit(cache=True, nogil=True)
def _factor(law, w, y, v, scale_nm, slow_s, quick_s, bound):  # pragma: no cover
    """Factors on T, on the slower and on the quicker lag; `law` holds a value for each `SpeedLaw`."""
    m = 1.0
    if law[SpeedLaw.RATIO_BY_DRIVE] != 0.0:
        d = (w - y) / (0.02 * scale_nm)
        m *= np.exp(law[SpeedLaw.RATIO_BY_DRIVE] * 0.5 * (1.0 - d / np.sqrt(1.0 + d * d)))
    if law[SpeedLaw.RATIO_BY_RATE] != 0.0:
        d = v / (0.1 * scale_nm)
        m *= np.exp(law[SpeedLaw.RATIO_BY_RATE] * 0.5 * (1.0 - d / np.sqrt(1.0 + d * d)))
    level = abs(y) / scale_nm
    if law[SpeedLaw.TORQUE] != 0.0:
        m *= max(1.0 + law[SpeedLaw.TORQUE] * level, 0.08)
    if law[SpeedLaw.DRIVE] != 0.0:
        m *= max(1.0 + law[SpeedLaw.DRIVE] * abs(w) / scale_nm, 0.08)
    if law[SpeedLaw.EXPONENTIAL] != 0.0:
        m *= np.exp(law[SpeedLaw.EXPONENTIAL] * level)
    if law[SpeedLaw.INVERSE_TORQUE] != 0.0:
        m *= 1.0 / max(1.0 + law[SpeedLaw.INVERSE_TORQUE] * level, 0.08)
    if law[SpeedLaw.INVERSE_DRIVE] != 0.0:
        m *= 1.0 / max(1.0 + law[SpeedLaw.INVERSE_DRIVE] * abs(w) / scale_nm, 0.08)
    d = 1.0
    if law[SpeedLaw.SLOW_TORQUE] != 0.0:
        d *= max(1.0 + law[SpeedLaw.SLOW_TORQUE] * level, 0.08)
    if law[SpeedLaw.SLOW_RATIO_BY_DRIVE] != 0.0:
        gap = (w - y) / (0.02 * scale_nm)
        d *= np.exp(law[SpeedLaw.SLOW_RATIO_BY_DRIVE] * 0.5 * (1.0 - gap / np.sqrt(1.0 + gap * gap)))
    if law[SpeedLaw.SLOW_INVERSE_DRIVE] != 0.0:
        d *= 1.0 / max(1.0 + law[SpeedLaw.SLOW_INVERSE_DRIVE] * abs(w) / scale_nm, 0.08)
    if law[SpeedLaw.ACTIVATION] != 0.0:
        between = min(max((y + slow_s * v) / scale_nm, 0.0), 1.2)
        m *= max(1.0 + law[SpeedLaw.ACTIVATION] * between, 0.08)
    if law[SpeedLaw.LEVEL] != 0.0 or law[SpeedLaw.SLOW_LEVEL] != 0.0:
        gap = (w - y) / (0.02 * scale_nm)
        side = np.log(0.5 + 1.5 * min(level, 1.2)) * gap / np.sqrt(1.0 + gap * gap)
        m *= np.exp(law[SpeedLaw.LEVEL] * side)
        d *= np.exp(law[SpeedLaw.SLOW_LEVEL] * side)
    if law[SpeedLaw.SLOW_SATURATING_DRIVE] != 0.0:
        part = abs(w) / scale_nm
        d *= max(1.0 + law[SpeedLaw.SLOW_SATURATING_DRIVE] * 1.15 * part / (part + 0.15), 0.08)
    q = 1.0
    if law[SpeedLaw.QUICK_RATIO_BY_RATE] != 0.0 or law[SpeedLaw.SLOW_RATIO_BY_RATE] != 0.0:
        gap = v / (0.1 * scale_nm)
        side = 0.5 * (1.0 - gap / np.sqrt(1.0 + gap * gap))
        q *= np.exp(law[SpeedLaw.QUICK_RATIO_BY_RATE] * side)
        d *= np.exp(law[SpeedLaw.SLOW_RATIO_BY_RATE] * side)
    if law[SpeedLaw.QUICK_RATIO_BY_DRIVE] != 0.0:
        gap = (w - y) / (0.02 * scale_nm)
        q *= np.exp(law[SpeedLaw.QUICK_RATIO_BY_DRIVE] * 0.5 * (1.0 - gap / np.sqrt(1.0 + gap * gap)))
    if law[SpeedLaw.SLOW_CALCIUM] != 0.0:
        d *= max(1.0 + law[SpeedLaw.SLOW_CALCIUM] * bound, 0.08)
    if law[SpeedLaw.QUICK_CALCIUM] != 0.0:
        q *= max(1.0 + law[SpeedLaw.QUICK_CALCIUM] * bound, 0.08)
    if law[SpeedLaw.SLOW_PUMP] != 0.0:
        d *= _uptake(law[SpeedLaw.SLOW_PUMP], w / scale_nm, (y + quick_s * v) / scale_nm)
    if law[SpeedLaw.QUICK_PUMP] != 0.0:
        q *= _uptake(law[SpeedLaw.QUICK_PUMP], w / scale_nm, (y + slow_s * v) / scale_nm)
    return min(max(m, 0.02), 50.0), min(max(d, 0.02), 50.0), min(max(q, 0.02), 50.0)


@njit(cache=True, nogil=True)
def _second(law, linear, inverse, y, v, lag_s, scale_nm):  # pragma: no cover
    """Factor on the second of two lags; `lag_s` is its present value, s."""
    factor = 1.0
    if law[linear] != 0.0:
        factor *= max(1.0 + law[linear] * min(max((y + lag_s * v) / scale_nm, 0.0), 1.2), 0.08)
    if law[inverse] != 0.0:
        factor *= 1.0 / max(1.0 + law[inverse] * min(max(y / scale_nm, 0.0), 1.2), 0.08)
    return min(max(factor, 0.02), 50.0)


@njit(cache=True, nogil=True)
def run_core(
    drive, time_constant_s, damping, law, multiplier, begins, initial, scale_nm, step_s, shared
):  # pragma: no cover
    """Boundary states of rows of drives.

    Parameters
    ----------
    drive : ndarray, shape (M, K)
        Held drive of each interval, N·m.
    time_constant_s, damping : ndarray, shape (M,)
        T, s, and ζ.
    law : ndarray, shape (M, len(SpeedLaw))
        Coefficient of each speed law.
    multiplier : ndarray, shape (M or 1 or 0, K)
        A further, given factor on T; no rows if there is none.
    begins : ndarray of int, shape (B,)
        Intervals at whose start a part of the record begins; the first is 0.
    initial : ndarray, shape (M, B, 2)
        Torque, N·m, and its rate, N·m/s, with which each part begins.
    scale_nm : float
        Full torque, N·m.
    step_s : float
        Pulse interval, s.
    shared : bool
        Rows that differ from row 0 only in their drive use row 0's transitions. Their derivative then ignores that the
        drive changes the speed: ten times faster, and good enough for the fit.

    Returns
    -------
    torque_nm, rate_nm_s : ndarray, shape (M, K + 1)
    """
    rows, size = drive.shape
    given = multiplier.shape[0]
    torque = np.zeros((rows, size + 1))
    rate = np.zeros((rows, size + 1))
    first, none, even = np.empty((4, size)), np.empty((4, 0)), np.zeros((rows, 4))
    listed, counts = np.empty((2, rows), np.int64), np.zeros(2, np.int64)  # rows without a law; those like row 0
    varied = False
    for m in range(rows):
        base = time_constant_s[m]
        slow_s = base * (damping[m] + np.sqrt(max(damping[m] * damping[m] - 1.0, 0.0)))
        quick_s = 2.0 * damping[m] * base - slow_s
        lawful = False
        for j in range(law.shape[1]):
            lawful = lawful or law[m, j] != 0.0
        alike = shared and m > 0 and base == time_constant_s[0] and damping[m] == damping[0]
        for j in range(law.shape[1]):
            alike = alike and law[m, j] == law[0, j]
        y, v, bound, part = 0.0, 0.0, 0.0, 0
        slow_second = law[m, SpeedLaw.SLOW_SECOND_ACTIVATION] != 0.0 or law[m, SpeedLaw.SLOW_SECOND_ATTACHED] != 0.0
        quick_second = law[m, SpeedLaw.QUICK_SECOND_ACTIVATION] != 0.0 or law[m, SpeedLaw.QUICK_SECOND_ATTACHED] != 0.0
        last = 1.0
        forget = np.exp(-step_s / PARTS / max(quick_s if law[m, SpeedLaw.SLOW_CALCIUM] != 0.0 else slow_s, 1e-4))
        kind = 1 if alike and varied else 0
        if kind or (not lawful and given == 0):
            listed[kind, counts[kind]] = m
            counts[kind] += 1
            even[m, 0], even[m, 1], even[m, 2], even[m, 3] = step_matrix(base, damping[m], step_s)
            continue
        h = step_s / PARTS
        for k in range(size):
            if part < begins.size and k == begins[part]:
                y, v = initial[m, part, 0], initial[m, part, 1]
                torque[m, k], rate[m, k] = y, v
                part += 1
            w = drive[m, k]
            given_f = multiplier[m if given > 1 else 0, k] if given > 0 else 1.0
            p11, p12, p21, p22 = 1.0, 0.0, 0.0, 1.0
            # The law is evaluated several times in an interval, since its sign may change within it.
            for _ in range(PARTS):
                f, d, q = 1.0, 1.0, 1.0
                if lawful:
                    f, d, q = _factor(law[m], w, y, v, scale_nm, slow_s, quick_s, bound)
                turned = 1.0
                if slow_second or quick_second:
                    linear = SpeedLaw.SLOW_SECOND_ACTIVATION if slow_second else SpeedLaw.QUICK_SECOND_ACTIVATION
                    inverse = SpeedLaw.SLOW_SECOND_ATTACHED if slow_second else SpeedLaw.QUICK_SECOND_ATTACHED
                    lag_s = last * (slow_s if slow_second else quick_s)
                    second = _second(law[m], linear, inverse, y, v, lag_s, scale_nm)
                    if slow_second:
                        d *= second
                    else:
                        q *= second
                    turned, last = last / second, second
                v *= turned  # y' = (a - y) / lag: a stays the same when the lag changes
                f *= given_f
                # The slower lag times d, the quicker times q: T² = quick·slow, 2 ζ T = quick + slow.
                t = base * f * np.sqrt(d * q)
                z = 0.5 * f * (quick_s * q + slow_s * d) / t
                q11, q12, q21, q22 = step_matrix(t, z, h)
                gap = y - w
                y, v = w + q11 * gap + q12 * v, q21 * gap + q22 * v
                p21, p22 = turned * p21, turned * p22
                p11, p12, p21, p22 = (
                    q11 * p11 + q12 * p21,
                    q11 * p12 + q12 * p22,
                    q21 * p11 + q22 * p21,
                    q21 * p12 + q22 * p22,
                )
                goal = abs(w) / (abs(w) + 0.05 * scale_nm)
                bound = goal + (bound - goal) * forget
            if m == 0:
                varied = True
                first[0, k], first[1, k], first[2, k], first[3, k] = p11, p12, p21, p22
            torque[m, k + 1] = y
            rate[m, k + 1] = v
    four, step = np.zeros(4, np.int64), np.zeros((4, 4))
    for kind in range(2):
        for i in range(0, counts[kind], 4):
            for r in range(4):
                four[r] = listed[kind, min(i + r, counts[kind] - 1)]
                for j in range(4):
                    step[r, j] = even[four[r], j]
            through(drive, torque, rate, four, step, first if kind else none, begins, initial)
    return torque, rate


@njit(cache=True, nogil=True)
def activate(
    drive: np.ndarray, rise_s: np.ndarray, fall_s: np.ndarray, step_s: float
) -> np.ndarray:  # pragma: no cover
    """Mean over each interval of a, from 0; a' = (w - a)/τ, τ = rise if w > a, else fall; shapes (M, K), (M,).

    With τ = 0, a follows w at once.
    """
    rows, size = drive.shape
    out = np.empty((rows, size))
    for m in range(rows):
        a = 0.0
        for k in range(size):
            w = drive[m, k]
            tau = rise_s[m] if w > a else fall_s[m]
            if tau <= 0.0:
                a = w
                out[m, k] = w
            else:
                decay = np.exp(-step_s / tau)
                out[m, k] = w + (a - w) * (1.0 - decay) * tau / step_s
                a = w + (a - w) * decay
    return out

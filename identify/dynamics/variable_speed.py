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
def _line(slope, x):  # pragma: no cover
    """1 + slope x, at least 0.08."""
    return max(1.0 + slope * x, 0.08) if slope != 0.0 else 1.0


@njit(cache=True, nogil=True)
def _below(log_ratio, gap):  # pragma: no cover
    """The ratio where a gap, in units of a soft edge, is negative; 1 where it is positive."""
    return np.exp(log_ratio * 0.5 * (1.0 - gap / np.sqrt(1.0 + gap * gap))) if log_ratio != 0.0 else 1.0


@njit(cache=True, nogil=True)
def _share(x):  # pragma: no cover
    return min(max(x, 0.0), 1.2)


@njit(cache=True, nogil=True)
def _uptake(slope, w, a):  # pragma: no cover
    """Factor on the lag of a saturating uptake, where w/(1 + s w) - a/(1 + s a) drives a towards w."""
    return _line(slope, _share(w)) * _line(slope, _share(a)) if slope != 0.0 else 1.0


@njit(cache=True, nogil=True)
def _bounded(factor):  # pragma: no cover
    return min(max(factor, 0.02), 50.0)


@njit(cache=True, nogil=True)
def _factor(law, w, y, v, scale_nm, slow_s, quick_s, bound):  # pragma: no cover
    """Factors on T, on the slower and on the quicker lag; `law` holds a value for each `SpeedLaw`."""
    level, part = abs(y) / scale_nm, abs(w) / scale_nm
    lacking, rising = (w - y) / (0.02 * scale_nm), v / (0.1 * scale_nm)
    m = _below(law[SpeedLaw.RATIO_BY_DRIVE], lacking) * _below(law[SpeedLaw.RATIO_BY_RATE], rising)
    m = m * _line(law[SpeedLaw.TORQUE], level) * _line(law[SpeedLaw.DRIVE] * abs(w) / scale_nm, 1.0)
    if law[SpeedLaw.EXPONENTIAL] != 0.0:
        m *= np.exp(law[SpeedLaw.EXPONENTIAL] * level)
    m *= 1.0 / _line(law[SpeedLaw.INVERSE_TORQUE], level)
    m *= 1.0 / _line(law[SpeedLaw.INVERSE_DRIVE] * abs(w) / scale_nm, 1.0)
    m *= _line(law[SpeedLaw.ACTIVATION], _share((y + slow_s * v) / scale_nm))
    d = _line(law[SpeedLaw.SLOW_TORQUE], level) * _below(law[SpeedLaw.SLOW_RATIO_BY_DRIVE], lacking)
    d *= 1.0 / _line(law[SpeedLaw.SLOW_INVERSE_DRIVE] * abs(w) / scale_nm, 1.0)
    if law[SpeedLaw.LEVEL] != 0.0 or law[SpeedLaw.SLOW_LEVEL] != 0.0:
        side = np.log(0.5 + 1.5 * min(level, 1.2)) * lacking / np.sqrt(1.0 + lacking * lacking)
        m *= np.exp(law[SpeedLaw.LEVEL] * side)
        d *= np.exp(law[SpeedLaw.SLOW_LEVEL] * side)
    if law[SpeedLaw.SLOW_SATURATING_DRIVE] != 0.0:
        d *= max(1.0 + law[SpeedLaw.SLOW_SATURATING_DRIVE] * 1.15 * part / (part + 0.15), 0.08)
    d *= _below(law[SpeedLaw.SLOW_RATIO_BY_RATE], rising)
    d = d * _line(law[SpeedLaw.SLOW_CALCIUM], bound)
    d *= _uptake(law[SpeedLaw.SLOW_PUMP], w / scale_nm, (y + quick_s * v) / scale_nm)
    q = _below(law[SpeedLaw.QUICK_RATIO_BY_RATE], rising) * _below(law[SpeedLaw.QUICK_RATIO_BY_DRIVE], lacking)
    q = q * _line(law[SpeedLaw.QUICK_CALCIUM], bound)
    q *= _uptake(law[SpeedLaw.QUICK_PUMP], w / scale_nm, (y + slow_s * v) / scale_nm)
    return _bounded(m), _bounded(d), _bounded(q)


@njit(cache=True, nogil=True)
def _second(law, linear, inverse, y, v, lag_s, scale_nm):  # pragma: no cover
    """Factor on the second of two lags; `lag_s` is its present value, s."""
    factor = _line(law[linear], _share((y + lag_s * v) / scale_nm))
    return _bounded(factor * (1.0 / _line(law[inverse], _share(y / scale_nm))))


@njit(cache=True, nogil=True)
def run_core(
    drive, time_constant_s, damping, law, multiplier, begins, initial, scale_nm, step_s, shared
):  # pragma: no cover
    """Boundary states of rows of drives, torque, N·m, and its rate, each of shape (M, K + 1).

    `drive`, (M, K), is held in each interval; T, s, and ζ have shape (M,), `law` (M, len(SpeedLaw)). `multiplier`,
    (M or 1 or 0, K), is a further, given factor on T; no rows if there is none. Each part begins at an interval of
    `begins`, (B,), the first 0, with its torque and rate in `initial`, (M, B, 2). `scale_nm` is the full torque.

    With `shared`, rows that differ from row 0 in their drive alone use its transitions. Their derivative then ignores
    that the drive changes the speed: ten times faster, and good enough for the fit.
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
        lawful = np.any(law[m] != 0.0)
        alike = shared and m > 0 and base == time_constant_s[0] and damping[m] == damping[0]
        alike = alike and np.all(law[m] == law[0])
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
                    d, q = (d * second, q) if slow_second else (d, q * second)
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

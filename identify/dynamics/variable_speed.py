"""Second-order muscle dynamics whose speed depends on the state; compiled.

T² y'' + 2 ζ T y' + y = w, with w held over each pulse interval. A speed law multiplies T, or one of the two lags, by a
factor that depends on the state. Without a law the transition of the linear dynamics is used, bit for bit.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit

from stimrig.identify.dynamics.second_order import step_matrix, through

PARTS = 3
"""Number of steps within a pulse interval in which a speed law is evaluated."""


class Lag(IntEnum):
    """Target of a speed law: T, and so both lags, or one of them."""

    BOTH = 0
    SLOW = 1
    QUICK = 2


class SpeedLaw(IntEnum):
    """Dependences of the speed: each law is a column of the kernel's table, and is neutral at 0.

    y is the torque, w the drive, a the state between the two lags, all as shares of y_max.
    """

    RATIO = 0  # log ratio while the drive is below the torque
    LEVEL = 1  # power of 0.5 + 1.5 y/y_max; slower to rise and quicker to fall at high levels
    EXPONENTIAL = 2  # exponential in torque
    PUMP = 3  # of two lags in a row the first: a pump that saturates, linear in a and in drive
    SECOND_ACTIVATION = 4  # of two lags in a row the second: linear in its input a
    SECOND_ATTACHED = 5  # the same: inverse linear in torque


@njit(cache=True, nogil=True)
def _line(slope, x):  # pragma: no cover
    """1 + slope x, at least 0.08."""
    return max(1.0 + slope * x, 0.08) if slope != 0.0 else 1.0


@njit(cache=True, nogil=True)
def _share(x):  # pragma: no cover
    return min(max(x, 0.0), 1.2)


@njit(cache=True, nogil=True)
def _bounded(factor):  # pragma: no cover
    return min(max(factor, 0.02), 50.0)


@njit(cache=True, nogil=True)
def _factor(law, w, y, v, scale_nm, lag_s):  # pragma: no cover
    """Factor on T or on one lag; `law` holds a value for each `SpeedLaw`, y follows a with `lag_s`."""
    level, f = abs(y) / scale_nm, 1.0
    if law[SpeedLaw.RATIO] != 0.0 or law[SpeedLaw.LEVEL] != 0.0:
        lacking = (w - y) / (0.02 * scale_nm)
        side = lacking / np.sqrt(1.0 + lacking * lacking)  # -1 where the drive is below the torque, 1 where it is above
        f *= np.exp(law[SpeedLaw.RATIO] * 0.5 * (1.0 - side))
        f *= np.exp(law[SpeedLaw.LEVEL] * np.log(0.5 + 1.5 * min(level, 1.2)) * side)
    if law[SpeedLaw.EXPONENTIAL] != 0.0:
        f *= np.exp(law[SpeedLaw.EXPONENTIAL] * level)
    if law[SpeedLaw.PUMP] != 0.0:  # w/(1 + s w) - a/(1 + s a) drives a towards w
        slope, a = law[SpeedLaw.PUMP], y + lag_s * v
        f *= _line(slope, _share(w / scale_nm)) * _line(slope, _share(a / scale_nm))
    return _bounded(f)


@njit(cache=True, nogil=True)
def _is_second(law):  # pragma: no cover
    return law[SpeedLaw.SECOND_ACTIVATION] != 0.0 or law[SpeedLaw.SECOND_ATTACHED] != 0.0


@njit(cache=True, nogil=True)
def _second(law, y, v, lag_s, scale_nm):  # pragma: no cover
    """Factor on the second of two lags; `lag_s` is its present value, s."""
    factor = _line(law[SpeedLaw.SECOND_ACTIVATION], _share((y + lag_s * v) / scale_nm))
    return _bounded(factor * (1.0 / _line(law[SpeedLaw.SECOND_ATTACHED], _share(y / scale_nm))))


@njit(cache=True, nogil=True)
def run_core(drive, time_constant_s, damping, law, begins, initial, scale_nm, step_s):  # pragma: no cover
    """Boundary states of rows of drives, torque, N·m, and its rate, each of shape (M, K + 1).

    `drive`, (M, K), is held in each interval; T, s, and ζ have shape (M,), `law` (M, len(Lag), len(SpeedLaw)).
    Each part begins at an interval of `begins`, (B,), the first 0, with its torque and rate in `initial`, (M, B, 2).
    `scale_nm` is the full torque.

    Rows that differ from row 0 in their drive alone use its transitions. Their derivative then ignores that the drive
    changes the speed: ten times faster, and good enough for the fit.
    """
    rows, size = drive.shape
    torque = np.zeros((rows, size + 1))
    rate = np.zeros((rows, size + 1))
    first, none, even = np.empty((4, size)), np.empty((4, 0)), np.zeros((rows, 4))
    kinds, varied = np.full(rows, 2), False  # 0: without a law; 1: like row 0
    for m in range(rows):
        base = time_constant_s[m]
        slow_s = base * (damping[m] + np.sqrt(max(damping[m] * damping[m] - 1.0, 0.0)))
        quick_s = 2.0 * damping[m] * base - slow_s
        both, slow, quick = law[m, Lag.BOTH], law[m, Lag.SLOW], law[m, Lag.QUICK]
        on_both, on_slow, on_quick = np.any(both != 0.0), np.any(slow != 0.0), np.any(quick != 0.0)
        same_law = m > 0 and base == time_constant_s[0] and damping[m] == damping[0] and np.all(law[m] == law[0])
        y, v, part = 0.0, 0.0, 0
        slow_second, quick_second, last = _is_second(slow), _is_second(quick), 1.0
        kind = 1 if same_law and varied else 0
        if kind or not (on_both or on_slow or on_quick):
            kinds[m] = kind
            even[m, 0], even[m, 1], even[m, 2], even[m, 3] = step_matrix(base, damping[m], step_s)
            continue
        h = step_s / PARTS
        for k in range(size):
            if part < begins.size and k == begins[part]:
                y, v = initial[m, part, 0], initial[m, part, 1]
                torque[m, k], rate[m, k] = y, v
                part += 1
            w = drive[m, k]
            p11, p12, p21, p22 = 1.0, 0.0, 0.0, 1.0
            # The law is evaluated several times in an interval, since its sign may change within it.
            for _ in range(PARTS):
                f = _factor(both, w, y, v, scale_nm, slow_s) if on_both else 1.0
                d = _factor(slow, w, y, v, scale_nm, quick_s) if on_slow else 1.0
                q = _factor(quick, w, y, v, scale_nm, slow_s) if on_quick else 1.0
                turned = 1.0
                if slow_second or quick_second:
                    second_law, lag_s = (slow, last * slow_s) if slow_second else (quick, last * quick_s)
                    second = _second(second_law, y, v, lag_s, scale_nm)
                    d, q = (d * second, q) if slow_second else (d, q * second)
                    turned, last = last / second, second
                v *= turned  # y' = (a - y) / lag: a stays the same when the lag changes
                # The slower lag times d, the quicker times q: T² = quick·slow, 2 ζ T = quick + slow.
                t = base * f * np.sqrt(d * q)
                z = 0.5 * f * (quick_s * q + slow_s * d) / t
                q11, q12, q21, q22 = step_matrix(t, z, h)
                gap = y - w
                y, v = w + q11 * gap + q12 * v, q21 * gap + q22 * v
                p21, p22 = turned * p21, turned * p22
                p11, p21 = q11 * p11 + q12 * p21, q21 * p11 + q22 * p21
                p12, p22 = q11 * p12 + q12 * p22, q21 * p12 + q22 * p22
            if m == 0:
                varied = True
                first[0, k], first[1, k], first[2, k], first[3, k] = p11, p12, p21, p22
            torque[m, k + 1] = y
            rate[m, k + 1] = v
    for kind in range(2):
        alike, count = np.empty(rows, np.int64), 0
        for m in range(rows):
            if kinds[m] == kind:
                alike[count] = m
                count += 1
        through(drive, torque, rate, alike[:count], even, first if kind else none, begins, initial)
    return torque, rate

"""Second-order muscle dynamics whose speed may vary from pulse to pulse, compiled.

T² y'' + 2 ζ T y' + y = w with w held over each pulse interval, and T there multiplied by a factor that depends on the
state at its start. Where the factor is exactly 1 the transition of the base is used, bit for bit.
"""

from __future__ import annotations

import numpy as np
from numba import njit

PARTS = 3
"""Steps in which a speed law is followed through a pulse interval."""
MEAN_OF_SLOW = 0.27
"""Correlation of neighbouring innovations that averaging over an interval brings, at most."""
SHORTEST = 0.006
"""1 - ar1 of the slowest noise (a memory of 4 s at 40 pulses/s): what is slower is a drift, and has a cause."""
LAWS = 27
"""Columns of the speed law: see `factor`."""


@njit(cache=True, nogil=True, inline="always")
def _transition(time_constant_s, damping, step_s):  # pragma: no cover
    h = step_s / time_constant_s
    decay = np.exp(-damping * h)
    gap = damping * damping - 1.0
    root = np.sqrt(abs(gap))
    arg = root * h
    if abs(gap) < 1e-10:
        c, s = 1.0, h
    elif gap < 0:
        c, s = np.cos(arg), np.sin(arg) / root
    else:
        c, s = np.cosh(arg), np.sinh(arg) / root
    return (
        decay * (c + damping * s),
        decay * s * time_constant_s,
        -decay * s / time_constant_s,
        decay * (c - damping * s),
    )


@njit(cache=True, nogil=True, inline="always")
def _uptake(slope, w, a):  # pragma: no cover
    """Lag of a pump that saturates, w/(1 + s w) - a/(1 + s a) being what drives a towards w."""
    w, a = min(max(w, 0.0), 1.2), min(max(a, 0.0), 1.2)
    return max(1.0 + slope * w, 0.08) * max(1.0 + slope * a, 0.08)


@njit(cache=True, nogil=True, inline="always")
def _factor(law, w, y, v, scale_nm, slow_s, quick_s, bound):  # pragma: no cover
    """Factors on T, on the slower and on the quicker lag. `law` holds, each neutral at 0:

    0 log ratio where the drive is below the torque (relaxing), 1 log ratio where torque falls,
    2 linear in torque, 3 linear in drive, 4 exponential in torque, 5 inverse linear in torque,
    6 inverse linear in drive; on the slower of the two lags alone:
    7 linear in torque, 8 log ratio where the drive is below the torque, 9 inverse linear in drive,
    10 linear in activation (the state between the two lags), 11 on T, linear in activation, 12 on T, power of
    0.5 + 1.5 a: slower to rise and quicker to fall at high levels, 13 linear in a drive that saturates;
    on the quicker lag: 14 linear in activation, 15 log ratio where torque falls, 16 log ratio where the drive is
    below the torque; 17 as 15 on the slower lag; 18 slower lag, linear in bound calcium c (c follows whether there is
    drive at all, with the quicker lag), 19 quicker lag, linear in c (with the slower lag);
    20 as 12 on the slower lag; two lags in a row, of which the second keeps its input a when its speed changes:
    21 the slower second and linear in a, 22 the slower second and inverse linear in torque, 23 and 24 the same with
    the quicker second; of which the first is a pump that saturates, linear in a and in drive: 25 the slower, 26 the
    quicker first.
    """
    m = 1.0
    if law[0] != 0.0:
        d = (w - y) / (0.02 * scale_nm)
        m *= np.exp(law[0] * 0.5 * (1.0 - d / np.sqrt(1.0 + d * d)))
    if law[1] != 0.0:
        d = v / (0.1 * scale_nm)
        m *= np.exp(law[1] * 0.5 * (1.0 - d / np.sqrt(1.0 + d * d)))
    level = abs(y) / scale_nm
    if law[2] != 0.0:
        m *= max(1.0 + law[2] * level, 0.08)
    if law[3] != 0.0:
        m *= max(1.0 + law[3] * abs(w) / scale_nm, 0.08)
    if law[4] != 0.0:
        m *= np.exp(law[4] * level)
    if law[5] != 0.0:
        m *= 1.0 / max(1.0 + law[5] * level, 0.08)
    if law[6] != 0.0:
        m *= 1.0 / max(1.0 + law[6] * abs(w) / scale_nm, 0.08)
    d = 1.0
    if law[7] != 0.0:
        d *= max(1.0 + law[7] * level, 0.08)
    if law[8] != 0.0:
        gap = (w - y) / (0.02 * scale_nm)
        d *= np.exp(law[8] * 0.5 * (1.0 - gap / np.sqrt(1.0 + gap * gap)))
    if law[9] != 0.0:
        d *= 1.0 / max(1.0 + law[9] * abs(w) / scale_nm, 0.08)
    if law[10] != 0.0 or law[11] != 0.0:
        between = min(max((y + slow_s * v) / scale_nm, 0.0), 1.2)
        d *= max(1.0 + law[10] * between, 0.08)
        m *= max(1.0 + law[11] * between, 0.08)
    if law[12] != 0.0 or law[20] != 0.0:
        gap = (w - y) / (0.02 * scale_nm)
        side = np.log(0.5 + 1.5 * min(level, 1.2)) * gap / np.sqrt(1.0 + gap * gap)
        m *= np.exp(law[12] * side)
        d *= np.exp(law[20] * side)
    if law[13] != 0.0:
        part = abs(w) / scale_nm
        d *= max(1.0 + law[13] * 1.15 * part / (part + 0.15), 0.08)
    q = 1.0
    if law[14] != 0.0:
        between = min(max((y + quick_s * v) / scale_nm, 0.0), 1.2)
        q *= max(1.0 + law[14] * between, 0.08)
    if law[15] != 0.0 or law[17] != 0.0:
        gap = v / (0.1 * scale_nm)
        side = 0.5 * (1.0 - gap / np.sqrt(1.0 + gap * gap))
        q *= np.exp(law[15] * side)
        d *= np.exp(law[17] * side)
    if law[16] != 0.0:
        gap = (w - y) / (0.02 * scale_nm)
        q *= np.exp(law[16] * 0.5 * (1.0 - gap / np.sqrt(1.0 + gap * gap)))
    if law[18] != 0.0:
        d *= max(1.0 + law[18] * bound, 0.08)
    if law[19] != 0.0:
        q *= max(1.0 + law[19] * bound, 0.08)
    if law[25] != 0.0:
        d *= _uptake(law[25], w / scale_nm, (y + quick_s * v) / scale_nm)
    if law[26] != 0.0:
        q *= _uptake(law[26], w / scale_nm, (y + slow_s * v) / scale_nm)
    return min(max(m, 0.02), 50.0), min(max(d, 0.02), 50.0), min(max(q, 0.02), 50.0)


@njit(cache=True, nogil=True, inline="always")
def _second(law, linear, inverse, y, v, lag_s, scale_nm):  # pragma: no cover
    """Factor on the second of two lags; `lag_s` is what it is now."""
    factor = 1.0
    if law[linear] != 0.0:
        factor *= max(1.0 + law[linear] * min(max((y + lag_s * v) / scale_nm, 0.0), 1.2), 0.08)
    if law[inverse] != 0.0:
        factor *= 1.0 / max(1.0 + law[inverse] * min(max(y / scale_nm, 0.0), 1.2), 0.08)
    return min(max(factor, 0.02), 50.0)


@njit(cache=True, nogil=True)
def run_core(drive, time_constant_s, damping, law, multiplier, scale_nm, step_s, shared):  # pragma: no cover
    """Boundary states of rows of drives.

    Parameters
    ----------
    drive : ndarray, shape (M, K)
        Held drive of each interval, N·m.
    time_constant_s, damping : ndarray, shape (M,)
        T, s, and ζ.
    law : ndarray, shape (M, LAWS)
        Coefficients of the speed law.
    multiplier : ndarray, shape (M or 1 or 0, K)
        A further factor on T, given; no rows where there is none.
    scale_nm : float
        Torque that counts as full, N·m.
    step_s : float
        Pulse interval, s.
    shared : bool
        Rows that differ from row 0 by their drive alone go through row 0's transitions: a derivative by the drive
        without that of the speed, ten times cheaper and good enough to descend by.

    Returns
    -------
    torque_nm, rate_nm_s : ndarray, shape (M, K + 1)
    """
    rows, size = drive.shape
    given = multiplier.shape[0]
    torque = np.zeros((rows, size + 1))
    rate = np.zeros((rows, size + 1))
    first = np.empty((4, size))
    varied = False
    for m in range(rows):
        base = time_constant_s[m]
        b11, b12, b21, b22 = _transition(base, damping[m], step_s)
        slow_s = base * (damping[m] + np.sqrt(max(damping[m] * damping[m] - 1.0, 0.0)))
        quick_s = 2.0 * damping[m] * base - slow_s
        lawful = False
        for j in range(law.shape[1]):
            lawful = lawful or law[m, j] != 0.0
        alike = shared and m > 0 and base == time_constant_s[0] and damping[m] == damping[0]
        for j in range(law.shape[1]):
            alike = alike and law[m, j] == law[0, j]
        y, v, bound = 0.0, 0.0, 0.0
        slow_second = law[m, 21] != 0.0 or law[m, 22] != 0.0
        quick_second = law[m, 23] != 0.0 or law[m, 24] != 0.0
        last = 1.0
        forget = np.exp(-step_s / PARTS / max(quick_s if law[m, 18] != 0.0 else slow_s, 1e-4))
        if alike and varied:
            for k in range(size):
                w = drive[m, k]
                gap = y - w
                y, v = w + first[0, k] * gap + first[1, k] * v, first[2, k] * gap + first[3, k] * v
                torque[m, k + 1] = y
                rate[m, k + 1] = v
            continue
        if not lawful and given == 0:
            for k in range(size):
                w = drive[m, k]
                gap = y - w
                y, v = w + b11 * gap + b12 * v, b21 * gap + b22 * v
                torque[m, k + 1] = y
                rate[m, k + 1] = v
            continue
        h = step_s / PARTS
        for k in range(size):
            w = drive[m, k]
            given_f = multiplier[m if given > 1 else 0, k] if given > 0 else 1.0
            p11, p12, p21, p22 = 1.0, 0.0, 0.0, 1.0
            # The law is asked several times in an interval: its side may turn in between.
            for _ in range(PARTS):
                f, d, q = 1.0, 1.0, 1.0
                if lawful:
                    f, d, q = _factor(law[m], w, y, v, scale_nm, slow_s, quick_s, bound)
                turned = 1.0
                if slow_second:
                    second = _second(law[m], 21, 22, y, v, last * slow_s, scale_nm)
                    d *= second
                    turned, last = last / second, second
                elif quick_second:
                    second = _second(law[m], 23, 24, y, v, last * quick_s, scale_nm)
                    q *= second
                    turned, last = last / second, second
                v *= turned  # y' = (a - y) / lag: what is kept is a
                f *= given_f
                # The slower lag times d, the quicker times q: T² = quick·slow, 2 ζ T = quick + slow.
                t = base * f * np.sqrt(d * q)
                z = 0.5 * f * (quick_s * q + slow_s * d) / t
                q11, q12, q21, q22 = _transition(t, z, h)
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
    return torque, rate


@njit(cache=True, nogil=True)
def mean_weights(fraction, interval, count, shift):  # pragma: no cover
    """Weights of the boundary states in each interval's mean of samples read `shift` steps late.

    Returns
    -------
    first : int
        Offset of the earliest boundary.
    weights : ndarray, shape (K, B, 2)
        For (y, y' times step).
    """
    low, high = 1 << 30, -(1 << 30)
    for n in range(fraction.size):
        o = int(np.floor(fraction[n] - shift))
        low, high = min(low, o), max(high, o)
    width = high - low + 2
    weights = np.zeros((count.size, width, 2))
    for n in range(fraction.size):
        at = fraction[n] - shift
        o = int(np.floor(at))
        s = at - o
        k, b = interval[n], o - low
        r = 1.0 / count[k]
        weights[k, b, 0] += r * (1 + 2 * s) * (1 - s) ** 2
        weights[k, b, 1] += r * s * (1 - s) ** 2
        weights[k, b + 1, 0] += r * s * s * (3 - 2 * s)
        weights[k, b + 1, 1] += r * s * s * (s - 1)
    return low, weights


@njit(cache=True, nogil=True)
def read_means(torque, rate, first, weights, step_s):  # pragma: no cover
    """Means over intervals, shape (M, K), from boundary states of shape (M, K + 1)."""
    rows, size = torque.shape[0], weights.shape[0]
    out = np.zeros((rows, size))
    for m in range(rows):
        for k in range(size):
            total = 0.0
            for b in range(weights.shape[1]):
                at = k + first + b
                if at < 0:
                    total += weights[k, b, 0] * torque[m, 0]
                elif at > size:
                    total += weights[k, b, 0] * torque[m, size]
                else:
                    total += weights[k, b, 0] * torque[m, at] + weights[k, b, 1] * rate[m, at] * step_s
            out[m, k] = total
    return out


@njit(cache=True, nogil=True)
def _ratio(ar1, mean):  # pragma: no cover
    """Variance of means of slow noise over that of their innovations."""
    return (1.0 + 2.0 * ar1 * mean + mean * mean) / (1.0 - ar1 * ar1)


@njit(cache=True, nogil=True)
def _whiten_means(rows, start, stop, ar1, mean, total):  # pragma: no cover
    """Innovations of means of slow noise, x[k] = ar1 x[k-1] + e[k] + mean e[k-1], by the innovations algorithm."""
    white = np.empty((rows.shape[0], total))
    first = _ratio(ar1, mean)
    logdet = 0.0
    for i in range(start.size):
        r = first
        for _ in range(stop[i] - start[i]):
            logdet += 0.5 * np.log(r / first)
            r = 1.0 + mean * mean - mean * mean / r
    for m in range(rows.shape[0]):
        f = 0
        for i in range(start.size):
            r, x = first, 0.0
            for k in range(start[i], stop[i]):
                e = rows[m, k] - x
                white[m, f] = e * np.sqrt(first / r)
                x = ar1 * rows[m, k] + mean * e / r
                r = 1.0 + mean * mean - mean * mean / r
                f += 1
    return white, logdet


@njit(cache=True, nogil=True)
def whiten_rows(rows, start, stop, ar1, share):  # pragma: no cover
    """Innovations of white plus AR(1) noise, scaled to equal variance, by an exact Kalman filter.

    Parameters
    ----------
    rows : ndarray, shape (M, K)
        Residuals or derivatives on the grid.
    start, stop : ndarray of int, shape (S,)
        Stretches of fitted intervals.
    ar1 : float
        Correlation of neighbours of the slow part.
    share : float
        Share of the variance that is slow, 0 … 1; the rest is white. Above 1: means of slow noise over an interval,
        which are smoother than slow noise read at instants.

    Returns
    -------
    white : ndarray, shape (M, F)
        Fitted intervals in order, unit variance where the total variance is 1.
    half_log_det : float
        0.5 log det of the correlation matrix.
    """
    total = 0
    for i in range(start.size):
        total += stop[i] - start[i]
    if share > 1.0:
        return _whiten_means(rows, start, stop, ar1, (share - 1.0) * MEAN_OF_SLOW, total)
    white = np.empty((rows.shape[0], total))
    gain = np.empty(total)
    scale = np.empty(total)
    logdet = 0.0
    f = 0
    noise = (1.0 - ar1 * ar1) * share
    for i in range(start.size):
        p = share
        for _ in range(stop[i] - start[i]):
            s = p + 1.0 - share
            s = max(s, 1e-12)
            gain[f] = p / s
            scale[f] = 1.0 / np.sqrt(s)
            logdet += 0.5 * np.log(s)
            p = ar1 * ar1 * (p - p * p / s) + noise
            f += 1
    for m in range(rows.shape[0]):
        f = 0
        for i in range(start.size):
            x = 0.0
            for k in range(start[i], stop[i]):
                e = rows[m, k] - x
                white[m, f] = e * scale[f]
                x = ar1 * (x + gain[f] * e)
                f += 1
    return white, logdet


@njit(cache=True, nogil=True)
def _squares(row, start, stop, ar1, share):  # pragma: no cover
    """Sum of squared innovations, half the log determinant, count; the filter's gain settles within some steps."""
    total, squares, logdet = 0, 0.0, 0.0
    if share > 1.0:
        mean = (share - 1.0) * MEAN_OF_SLOW
        first = _ratio(ar1, mean)
        for i in range(start.size):
            r, x = first, 0.0
            for k in range(start[i], stop[i]):
                e = row[k] - x
                squares += e * e * first / r
                if r != 1.0:
                    logdet += 0.5 * np.log(r / first)
                else:
                    logdet -= 0.5 * np.log(first)
                x = ar1 * row[k] + mean * e / r
                r = 1.0 + mean * mean - mean * mean / r
                total += 1
        return squares, logdet, total
    noise = (1.0 - ar1 * ar1) * share
    for i in range(start.size):
        p, x, k, end = share, 0.0, start[i], stop[i]
        total += end - k
        s = 1.0
        while k < end:
            s = max(p + 1.0 - share, 1e-12)
            e = row[k] - x
            squares += e * e / s
            logdet += 0.5 * np.log(s)
            x = ar1 * (x + p / s * e)
            fresh = ar1 * ar1 * (p - p * p / s) + noise
            k += 1
            if abs(fresh - p) < 1e-10 * (1e-6 + p):
                break
            p = fresh
        if k < end:
            gain, sum_e = p / s, 0.0
            logdet += 0.5 * (end - k) * np.log(s)
            for j in range(k, end):
                e = row[j] - x
                sum_e += e * e
                x = ar1 * (x + gain * e)
            squares += sum_e / s
    return squares, logdet, total


@njit(cache=True, nogil=True)
def _minus_log_likelihood(row, start, stop, ar1, share):  # pragma: no cover
    """Minus the profiled log-likelihood of one residual, up to a constant."""
    squares, logdet, total = _squares(row, start, stop, ar1, share)
    return 0.5 * total * np.log(max(squares / max(total, 1), 1e-24)) + logdet


@njit(cache=True, nogil=True)
def profile_noise(row, start, stop, ar1, share):  # pragma: no cover
    """Correlation and slow share that make a residual most likely, by a pattern search from where it stands.

    Returns
    -------
    ar1, share, sd, log_likelihood : float
        `sd` is the total standard deviation, slow and white together.
    """
    total = 0
    for i in range(start.size):
        total += stop[i] - start[i]
    # On the scale of memory: a = log(1 - ar1), from SHORTEST (long memory) to 1 (none).
    low, high = np.log(SHORTEST), 0.0
    a = min(max(np.log(1.0 - min(ar1, 1.0 - SHORTEST)), low), high)
    b = min(max(share, 0.0), 2.0)
    best = _minus_log_likelihood(row, start, stop, 1.0 - np.exp(a), b)
    for guess_a, guess_b in (
        (np.log(0.3), 0.9),
        (np.log(0.03), 0.3),
        (np.log(0.03), 1.0),
        (np.log(0.5), 0.02),
        (np.log(0.3), 1.7),
    ):
        value = _minus_log_likelihood(row, start, stop, 1.0 - np.exp(guess_a), guess_b)
        if value < best:
            best, a, b = value, guess_a, guess_b
    da, db = 0.6, 0.2
    while da > 0.01:
        moved = False
        for i in range(8):
            na = a + da * (1.0 if i in (0, 4, 5) else -1.0 if i in (1, 6, 7) else 0.0)
            nb = b + db * (1.0 if i in (2, 4, 6) else -1.0 if i in (3, 5, 7) else 0.0)
            na, nb = min(max(na, low), high), min(max(nb, 0.0), 2.0)
            if na == a and nb == b:
                continue
            value = _minus_log_likelihood(row, start, stop, 1.0 - np.exp(na), nb)
            if value < best - 1e-9:
                best, a, b, moved = value, na, nb, True
        if not moved:
            da, db = 0.5 * da, 0.5 * db
    ar1 = 1.0 - np.exp(a)
    squares = _squares(row, start, stop, ar1, b)[0]
    sd = np.sqrt(max(squares / max(total, 1), 1e-24))
    return ar1, b, sd, -best - 0.5 * total * (np.log(2 * np.pi) + 1.0)


@njit(cache=True, nogil=True, fastmath=True)
def gram(rows):  # pragma: no cover
    """rows @ rows.T for few long rows, on one core: a library's threads cost more than they give here."""
    count, size = rows.shape
    out = np.empty((count, count))
    for i in range(count):
        for j in range(i + 1):
            total = 0.0
            for k in range(size):
                total += rows[i, k] * rows[j, k]
            out[i, j] = total
            out[j, i] = total
    return out

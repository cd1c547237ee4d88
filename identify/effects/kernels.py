"""Compiled recursions over time. Rows are sets of parameters, columns are pulse intervals."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def adapt(
    drive: np.ndarray,
    onset_s: np.ndarray,
    recovery_s: np.ndarray,
    constant: bool,
    step_s: float,
    rest_s: np.ndarray,
    begin: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:  # pragma: no cover
    """State x in [0, 1] with x' = a (1 - x)/onset - (1 - a) x/recovery; exact for a held drive a.

    With `constant`, recovery also continues under stimulation: x' = a (1 - x)/onset - x/recovery.

    Parameters
    ----------
    drive : ndarray, shape (M, K)
        a, in [0, 1].
    onset_s, recovery_s : ndarray, shape (M,)
        Time constants, s.
    constant : bool
        Whether recovery is independent of the drive.
    step_s : float
        Length of an interval, s.
    rest_s : ndarray, shape (K,)
        Additional rest before each interval, s.
    begin : float
        x before the first of them.

    Returns
    -------
    ndarray, shape (M, K)
        Mean of x at the start and the end of each interval.
    ndarray, shape (M,)
        x after the last.
    """
    rows, size = drive.shape
    out, last = np.empty((rows, size)), np.empty(rows)
    for m in range(rows):
        x = begin
        for k in range(size):
            if rest_s[k] > 0.0:
                x *= np.exp(-rest_s[k] / recovery_s[m])
            a = min(max(drive[m, k], 0.0), 1.0)
            up = a / onset_s[m]
            down = 1.0 / recovery_s[m] if constant else (1.0 - a) / recovery_s[m]
            rate = up + down
            end = x
            if rate > 0.0:
                goal = up / rate
                end = goal + (x - goal) * np.exp(-rate * step_s)
            out[m, k] = 0.5 * (x + end)
            x = end
        last[m] = x
    return out, last


@njit(cache=True, nogil=True)
def play(width_us: np.ndarray, half_us: np.ndarray, growth_per_us: np.ndarray) -> np.ndarray:  # pragma: no cover
    """Play operator: the output stays within half (1 + growth·input) of the input; it starts at 0.

    Shapes (M, K), (M,), (M,).
    """
    rows, size = width_us.shape
    out = np.empty((rows, size))
    for m in range(rows):
        p = 0.0
        for k in range(size):
            u = width_us[m, k]
            half = half_us[m] * max(1.0 + growth_per_us[m] * u, 0.0)
            p = max(u - half, min(u + half, p))
            out[m, k] = p
    return out


@njit(cache=True, nogil=True)
def dahl(width_us: np.ndarray, reach_us: np.ndarray) -> np.ndarray:  # pragma: no cover
    """Dahl's friction, a memory of direction z in [-1, 1]: dz = (du - z |du|)/reach. Shapes (M, K), (M,).

    Before the first change z is 0.
    """
    rows, size = width_us.shape
    out = np.empty((rows, size))
    for m in range(rows):
        z, last = 0.0, 0.0
        for k in range(size):
            change = width_us[m, k] - last
            last = width_us[m, k]
            if change != 0.0:
                goal = 1.0 if change > 0.0 else -1.0
                z = goal + (z - goal) * np.exp(-abs(change) / reach_us[m])
            out[m, k] = z
    return out


@njit(cache=True, nogil=True)
def activate(
    drive: np.ndarray, rise_s: np.ndarray, fall_s: np.ndarray, step_s: float
) -> np.ndarray:  # pragma: no cover
    """First-order activation with time constants for rise and fall; mean over each interval, from 0.

    a' = (w - a)/τ, τ = rise if the drive is above the activation, else fall. With τ = 0, a follows w at once.
    Shapes (M, K), (M,).
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


@njit(cache=True, nogil=True)
def since_onset(on: np.ndarray, least_gap_s: float, step_s: float) -> np.ndarray:  # pragma: no cover
    """Time since the first pulse of the present train, s, at the middle of each interval; 1e9 without a pulse."""
    out = np.full(on.size, 1e9)
    gap, since = 1e9, 1e9
    for k in range(on.size):
        if on[k] > 0:
            if gap >= least_gap_s:
                since = 0.0
            gap = 0.0
            out[k] = since + 0.5 * step_s
            since += step_s
        else:
            gap += step_s
            since += step_s
    return out


@njit(cache=True, nogil=True, inline="always")
def _moved(phi, gamma, z, v, a, b, c, d):  # pragma: no cover
    return phi[0] * z + phi[1] * v + gamma[0] * a + gamma[1] * b + gamma[2] * c + gamma[3] * d


@njit(cache=True, nogil=True)
def follow(
    torque: np.ndarray, slope: np.ndarray, phi: np.ndarray, gamma: np.ndarray, step_s: float
) -> tuple[np.ndarray, np.ndarray]:  # pragma: no cover
    """Response of a second-order system to the cubic through boundary states; (M, K + 1) to (M, K + 1).

    `slope` is the rate times the step; `phi` (M, 2, 2) and `gamma` (M, 2, 4) act on (z, z'·step), (x0, x0', x1, x1').
    """
    rows, size = torque.shape
    out = np.zeros((rows, size))
    rate = np.zeros((rows, size))
    for m in range(rows):
        z, v = torque[m, 0], 0.0
        out[m, 0] = z
        for k in range(size - 1):
            a, b, c, d = torque[m, k], slope[m, k], torque[m, k + 1], slope[m, k + 1]
            z, v = (
                _moved(phi[m, 0], gamma[m, 0], z, v, a, b, c, d),
                _moved(phi[m, 1], gamma[m, 1], z, v, a, b, c, d),
            )
            out[m, k + 1] = z
            rate[m, k + 1] = v / step_s
    return out, rate


@njit(cache=True, nogil=True)
def exponential(matrix: np.ndarray) -> np.ndarray:  # pragma: no cover
    """Matrix exponential of a small matrix of norm up to about 20, by scaled Taylor series."""
    size = matrix.shape[0]
    scaled = matrix / 64.0
    term, total = np.eye(size), np.eye(size)
    for n in range(1, 13):
        term = _product(term, scaled) / n
        total += term
    for _ in range(6):
        total = _product(total, total)
    return total


@njit(cache=True, nogil=True)
def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:  # pragma: no cover
    size = a.shape[0]
    out = np.zeros((size, size))
    for i in range(size):
        for k in range(size):
            for j in range(size):
                out[i, j] += a[i, k] * b[k, j]
    return out


@njit(cache=True, nogil=True)
def train(on: np.ndarray, step_s: float, least_gap_s: float = 0.0) -> tuple[np.ndarray, np.ndarray]:  # pragma: no cover
    """Time under pulses since the onset of the present train, and the silence before that train, s.

    A silence longer than `least_gap_s` ends a train.
    """
    since = np.full(on.size, 1e9)
    before = np.zeros(on.size)
    gap, length, silence = 1e3, 0.0, 1e3
    for k in range(on.size):
        if on[k] > 0:
            if gap > least_gap_s:
                silence, length = gap, 0.0
            gap = 0.0
            since[k] = length + 0.5 * step_s
            before[k] = silence
            length += step_s
        else:
            gap += step_s
    return since, before


@njit(cache=True, nogil=True)
def activate_by_level(
    drive: np.ndarray, rise_s: np.ndarray, fall_s: np.ndarray, scale: float, step_s: float
) -> np.ndarray:  # pragma: no cover
    """As `activate`, with time constants that depend on the level: rise (0.5 + 1.5 a), fall/(0.5 + 1.5 a)."""
    rows, size = drive.shape
    parts = 5
    out = np.empty((rows, size))
    for m in range(rows):
        a = 0.0
        for k in range(size):
            w = drive[m, k]
            total = 0.0
            for _ in range(parts):
                level = 0.5 + 1.5 * min(max(abs(a) / scale, 0.0), 1.2)
                tau = rise_s[m] * level if w > a else fall_s[m] / level
                if tau <= 1e-9:
                    a = w
                    total += w
                else:
                    h = step_s / parts
                    decay = np.exp(-h / tau)
                    total += w + (a - w) * (1.0 - decay) * tau / h
                    a = w + (a - w) * decay
            out[m, k] = total / parts
    return out


SPRING_PARTS = 12
"""Leapfrog steps per interval: at 16 Hz and 40 pulses/s a step is a fifth of a radian."""


@njit(cache=True, nogil=True)
def follow_curved(
    torque: np.ndarray,
    slope: np.ndarray,
    omega: np.ndarray,
    damping: np.ndarray,
    curved: np.ndarray,
    toe: bool,
    step_s: float,
) -> tuple[np.ndarray, np.ndarray]:  # pragma: no cover
    """A mass on a nonlinear spring, driven by the cubic x through boundary states.

    With a toe q'' = ω² (x - z) - 2 ζ ω q', z = q (1 + β q²) the spring's torque; else z'' = ω² (1 + β |z|)(x - z) -
    2 ζ ω z'. Shapes (M, K) and (M,); β in 1/(N·m)² or 1/(N·m).
    """
    rows, size = torque.shape
    h = step_s / SPRING_PARTS
    out, rate = np.zeros((size, rows)), np.zeros((size, rows))
    x0, v0 = np.ascontiguousarray(torque.T), np.ascontiguousarray(slope.T)
    q, v = x0[0].copy(), np.zeros(rows)
    out[0] = q
    w2 = h * omega * omega
    c = damping * omega * h
    keep, give = (1.0 - c) / (1.0 + c), w2 / (1.0 + c)
    for k in range(size - 1):
        for i in range(SPRING_PARTS):
            s = (i + 0.5) / SPRING_PARTS
            a, b = (1 + 2 * s) * (1 - s) * (1 - s), s * (1 - s) * (1 - s)
            d, e = s * s * (3 - 2 * s), s * s * (s - 1)
            for m in range(rows):
                x = a * x0[k, m] + b * v0[k, m] + d * x0[k + 1, m] + e * v0[k + 1, m]
                z = q[m] + 0.5 * h * v[m]
                force = x - z * (1.0 + curved[m] * z * z) if toe else (1.0 + curved[m] * abs(z)) * (x - z)
                v[m] = keep[m] * v[m] + give[m] * force
                q[m] = z + 0.5 * h * v[m]
        for m in range(rows):
            if not abs(q[m]) < 1e6:
                q[m], v[m] = 0.0, 0.0
            bent = curved[m] * q[m] * q[m] if toe else 0.0
            out[k + 1, m] = q[m] * (1.0 + bent)
            rate[k + 1, m] = v[m] * (1.0 + 3.0 * bent)
    return np.ascontiguousarray(out.T), np.ascontiguousarray(rate.T)


@njit(cache=True, nogil=True)
def bumps(
    time_s: np.ndarray, centre: np.ndarray, width: np.ndarray, height: np.ndarray, flatness: np.ndarray
) -> np.ndarray:  # pragma: no cover
    """Sum of bumps. Shapes (K,), (M, n) for each of three, flatness (M,); to (M, K). Negligible tails are skipped."""
    rows, count = centre.shape
    out = np.zeros((rows, time_s.size))
    for m in range(rows):
        reach = 80.0 ** (1.0 / flatness[m])
        for i in range(count):
            for k in range(time_s.size):
                away = abs((time_s[k] - centre[m, i]) / width[m, i])
                if away < reach:
                    out[m, k] += height[m, i] * np.exp(-0.5 * (away + 1e-12) ** flatness[m])
    return out


@njit(cache=True, nogil=True)
def used_up(
    on: np.ndarray, decay_s: np.ndarray, recovery_s: np.ndarray, step_s: float
) -> np.ndarray:  # pragma: no cover
    """x' = 1/decay under pulses, -x/recovery in silence. Shapes (K,), (M,), (M,); to (M, K)."""
    rows = decay_s.size
    out = np.empty((rows, on.size))
    for m in range(rows):
        x, gain, forget = 0.0, step_s / decay_s[m], np.exp(-step_s / recovery_s[m])
        for k in range(on.size):
            if on[k] > 0:
                out[m, k] = x + 0.5 * gain
                x += gain
            else:
                out[m, k] = x
                x *= forget
    return out


@njit(cache=True, nogil=True)
def relaxed(
    value: np.ndarray, time_s: np.ndarray, begins: np.ndarray, relaxation_s: np.ndarray
) -> np.ndarray:  # pragma: no cover
    """What follows a value by a first-order lag, exact for a value that goes straight from point to point.

    Parameters
    ----------
    value, time_s : ndarray, shape (K,)
        What is followed, and when, s.
    begins : ndarray of bool, shape (K,)
        Where it has already arrived: at the begin of each recording.
    relaxation_s : ndarray, shape (M,)
        Time constants, s.

    Returns
    -------
    ndarray, shape (M, K)
    """
    rows, size = relaxation_s.size, value.size
    out = np.empty((rows, size))
    for m in range(rows):
        z = value[0]
        out[m, 0] = z
        for k in range(1, size):
            step_s = time_s[k] - time_s[k - 1]
            if begins[k] or not step_s > 0.0:
                z = value[k]
            else:
                lag_s = relaxation_s[m]
                slope = (value[k] - value[k - 1]) / step_s
                z = value[k] - slope * lag_s + (z - value[k - 1] + slope * lag_s) * np.exp(-step_s / lag_s)
            out[m, k] = z
    return out

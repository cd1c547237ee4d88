"""Second-order muscle dynamics on the grid of pulses, exact for a held input.

The linear block of the paper in physical terms, T² y'' + 2 ζ T y' + y = w, with w held over each pulse interval.
The state (y, y') is carried from one pulse to the next by the matrix exponential; inside an interval y is a smooth
curve, read off the states at its two ends: exactly for a held input, as a cubic where both lags are long. A delay
therefore needs no states of its own: it shifts the times at which the curve is read.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

Core = tuple[float, float]
"""T, s, and ζ."""


def transition(time_constant_s: float, damping: float, step_s: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact transition of T² y'' + 2 ζ T y' + y = w over one step with w held.

    Parameters
    ----------
    time_constant_s : float
        T, s, positive.
    damping : float
        ζ, positive, 1 is critical.
    step_s : float or ndarray
        Length of the step, s; of several, the shape follows those below.

    Returns
    -------
    phi : ndarray, shape (2, 2)
        State transition of x = (y, y').
    gamma : ndarray, shape (2,)
        Input vector: x[k+1] = phi @ x[k] + gamma * w[k].
    """
    h = step_s / time_constant_s
    decay = np.exp(-damping * h)
    gap = damping * damping - 1.0
    root = np.sqrt(abs(gap))
    arg = root * h
    if abs(gap) < 1e-10:
        c, s = h**0, h
    elif gap < 0:
        c, s = np.cos(arg), np.sin(arg) / root
    else:
        c, s = np.cosh(arg), np.sinh(arg) / root
    p11 = decay * (c + damping * s)
    p12 = decay * s * time_constant_s
    p21 = -decay * s / time_constant_s
    p22 = decay * (c - damping * s)
    return np.array([[p11, p12], [p21, p22]]), np.array([1.0 - p11, -p21])


def recursion(a: np.ndarray, forced: np.ndarray) -> np.ndarray:
    """y[k] = forced[k] - a[1] y[k-1] - a[2] y[k-2] …, from rest, along the first axis.

    A lower triangular banded system, which LAPACK solves by exactly this recursion; scipy.signal's filter does the same
    but takes 0.3 s to import, a third of what `stimrig fit` may take as a whole.

    Parameters
    ----------
    a : ndarray, shape (l + 1,)
        Denominator, a[0] = 1.
    forced : ndarray, shape (K,) or (K, M)
        Right-hand side; in Fortran's order it is overwritten.
    """
    bands = np.empty((len(a), forced.shape[0]), order="F")
    bands[:] = np.asarray(a, float)[:, None]
    solved, _ = lapack.dtbtrs(  # pyright: ignore[reportAttributeAccessIssue]
        bands, forced if forced.ndim == 2 else forced[:, None], uplo="L", overwrite_b=True
    )
    return solved if forced.ndim == 2 else solved[:, 0]


def boundary_states(
    time_constant_s: float, damping: float, step_s: float, drive_nm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """States at the ends of the pulse intervals, from rest.

    Parameters
    ----------
    time_constant_s, damping, step_s : float
        As in `transition`.
    drive_nm : ndarray, shape (K,) or (K, M)
        Held input of each interval; columns are filtered apart.

    Returns
    -------
    torque_nm, rate_nm_s : ndarray, shape (K + 1,) or (K + 1, M)
        y and y' at the start of interval 0, …, at the end of interval K - 1.
    """
    phi, gamma = transition(time_constant_s, damping, step_s)
    trace, determinant = phi[0, 0] + phi[1, 1], phi[0, 0] * phi[1, 1] - phi[0, 1] * phi[1, 0]
    lead = (phi - trace * np.eye(2)) @ gamma
    a = np.array([1.0, -trace, determinant])
    torque = _forced(a, gamma[0], lead[0], drive_nm)
    if phi[0, 1] < 1e-3 * step_s:  # y' can't be had from y: a slow pulse rate, near a whole number of oscillations
        return torque, _forced(a, gamma[1], lead[1], drive_nm)
    # In place: fresh arrays of this size cost more than the sums.
    rate = np.empty_like(torque)
    inner = rate[:-1]
    np.multiply(torque[:-1], -phi[0, 0], out=inner)
    inner += torque[1:]
    inner -= np.multiply(drive_nm, gamma[0], out=np.empty_like(inner))
    inner /= phi[0, 1]
    rate[-1] = phi[1, 0] * torque[-2] + phi[1, 1] * rate[-2] + gamma[1] * drive_nm[-1]
    return torque, rate


def _forced(a: np.ndarray, gain: float, lead: float, drive_nm: np.ndarray) -> np.ndarray:
    right = np.empty((drive_nm.shape[0] + 1, *drive_nm.shape[1:]), order="F")
    right[:2] = 0.0
    np.multiply(drive_nm[:-1], lead, out=right[2:])
    right[1:] += np.multiply(drive_nm, gain, out=np.empty_like(right[1:]))
    return recursion(a, right)


def hermite(fraction: np.ndarray, step_s: float) -> np.ndarray:
    """Weights of (y0, y0', y1, y1') for the cubic at `fraction` of a step; shape (..., 4)."""
    s = np.asarray(fraction, float)
    return np.stack(
        [
            (1 + 2 * s) * (1 - s) ** 2,
            s * (1 - s) ** 2 * step_s,
            s * s * (3 - 2 * s),
            s * s * (s - 1) * step_s,
        ],
        axis=-1,
    )


def curve_weights(fraction: np.ndarray, step_s: float, core: Core | None) -> np.ndarray:
    """Weights of (y0, y0', y1, y1') for the curve of dynamics `core` at `fraction` of a step; shape (N, 4).

    The cubic, with the least change that makes it exact wherever the input is held: a lag of a few milliseconds bends
    the curve more sharply than a cubic can. Without `core` the cubic itself.
    """
    cubic = hermite(fraction, 1.0)
    unit = np.array([1.0, step_s, 1.0, step_s])
    if core is None:
        return cubic * unit
    ((_, from_rate), (_, rate)), (step, step_rate) = transition(*core, step_s * np.append(fraction, 1.0))
    # All that is possible under a held input: standing still, the response to a step, and that to an initial rate.
    ends = np.array(
        [
            [1.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 1.0, step_s * step_rate[-1] / step[-1]],
            [0.0, 1.0, from_rate[-1] / step_s, rate[-1]],
        ]
    )
    inside = np.stack([np.ones_like(fraction), step[:-1] / step[-1], from_rate[:-1] / step_s], axis=-1)
    return (cubic + (inside - cubic @ ends.T) @ np.linalg.solve(ends @ ends.T, ends)) * unit


def read_at(
    torque_nm: np.ndarray, rate_nm_s: np.ndarray, position: np.ndarray, step_s: float, core: Core | None = None
) -> np.ndarray:
    """The curve through the boundary states, read at times given in steps.

    Parameters
    ----------
    torque_nm, rate_nm_s : ndarray, shape (K + 1,)
        Boundary states.
    position : ndarray, shape (N,)
        Times in steps since the start of interval 0; before 0 the muscle is at rest, after K the last state stands.
    step_s : float
        Length of a step, s.
    core : (float, float) or None
        T, s, and ζ of the dynamics; a cubic where none is given.

    Returns
    -------
    ndarray, shape (N,)
    """
    last = torque_nm.shape[0] - 2
    interval = np.clip(np.floor(position).astype(np.int64), 0, last)
    fraction = np.clip(position - interval, 0.0, 1.0)
    weight = curve_weights(fraction, step_s, core)
    value = (
        weight[:, 0] * torque_nm[interval]
        + weight[:, 1] * rate_nm_s[interval]
        + weight[:, 2] * torque_nm[interval + 1]
        + weight[:, 3] * rate_nm_s[interval + 1]
    )
    return np.where(position < 0, torque_nm[0], value)


def free_states(time_constant_s: float, damping: float, step_s: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Undriven boundary states from a unit torque (column 0) and a unit rate (column 1); each (size + 1, 2)."""
    phi, _ = transition(time_constant_s, damping, step_s)
    trace = phi[0, 0] + phi[1, 1]
    a = np.array([1.0, -trace, phi[0, 0] * phi[1, 1] - phi[0, 1] * phi[1, 0]])
    start, turn = np.eye(2), phi - trace * np.eye(2)
    states = []
    for i in range(2):
        forced = np.zeros((size + 1, 2), order="F")
        forced[0] = start[i]
        forced[1] = turn[i]
        states.append(recursion(a, forced))
    return states[0], states[1]

"""The simulated muscle of section V of the paper, for Table I: sigmoid (35), underdamped second order, unit gain."""

from __future__ import annotations

import numpy as np

A1_NM, A2_PER_US, A3 = 6.8994, 0.0410, 2389.7
TIME_CONSTANT_S, DAMPING = 0.5284, 0.6369
TOP_US = 300.0
PULSE_RATE_HZ = 40.0


def recruitment(width_us: np.ndarray) -> np.ndarray:
    """f(u) of equation (35), N·m."""
    power = np.exp(A2_PER_US * np.asarray(width_us, float))
    return A1_NM * (power - 1.0) / (power + A3)


def torque(width_us: np.ndarray, sample_rate_hz: float) -> np.ndarray:
    """Clean torque at the samples for one pulse width an interval, from rest, N·m.

    It uses scipy's discretisation for a held input, so that the simulation does not depend on `identify.dynamics`.
    """
    from scipy.signal import cont2discrete, lfilter

    transfer = ([1.0], [TIME_CONSTANT_S**2, 2 * DAMPING * TIME_CONSTANT_S, 1.0])
    b, a = cont2discrete(transfer, 1.0 / sample_rate_hz, method="zoh")[:2]  # pyright: ignore
    each = round(sample_rate_hz / PULSE_RATE_HZ)
    return np.asarray(lfilter(np.ravel(b), np.ravel(a), np.repeat(recruitment(width_us), each)))


def prbs() -> np.ndarray:
    """Maximum-length sequence of 127 levels, 0 or the top, each held for 5 pulses; feedback from x⁷ + x⁶ + 1."""
    state, levels = [1] * 7, []
    for _ in range(127):
        levels.append(state[-1])
        state = [state[6] ^ state[5], *state[:-1]]
    return np.repeat(np.array(levels, float) * TOP_US, 5)


def ramp() -> np.ndarray:
    """Triangle 0 to top to 0, in 10 s."""
    up = np.linspace(0.0, TOP_US, round(5.0 * PULSE_RATE_HZ), endpoint=False)
    return np.r_[up, TOP_US - up]


def multilevel() -> np.ndarray:
    """Random levels over the whole range for 15 s, each held for 20 pulses; for validation only."""
    size = round(15.0 * PULSE_RATE_HZ)
    return np.repeat(np.random.default_rng(0).uniform(0.0, TOP_US, size // 20 + 1), 20)[:size]


def protocol() -> tuple[np.ndarray, list[str]]:
    """Width and segment name of each pulse: rest, PRBS, rest, ramp, rest, validate, rest (48 s)."""
    parts = [
        ("rest", np.zeros(40)),
        ("prbs", prbs()),
        ("rest", np.zeros(200)),
        ("ramp", ramp()),
        ("rest", np.zeros(120)),
        ("validate", multilevel()),
        ("rest", np.zeros(40)),
    ]
    return np.concatenate([part for _, part in parts]), [name for name, part in parts for _ in part]

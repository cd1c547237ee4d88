"""The simulated muscle of section V of the paper, for Table I: sigmoid (35), underdamped second order, unit gain."""

from __future__ import annotations

import numpy as np

A1_NM, A2_PER_US, A3 = 6.8994, 0.0410, 2389.7
TIME_CONSTANT_S, DAMPING = 0.5284, 0.6369
TOP_US = 300.0


def recruitment(width_us: np.ndarray) -> np.ndarray:
    """f(u) of equation (35), N·m."""
    power = np.exp(A2_PER_US * np.asarray(width_us, float))
    return A1_NM * (power - 1.0) / (power + A3)


def torque(width_us: np.ndarray, sample_rate_hz: float, pulse_rate_hz: float = 40.0) -> np.ndarray:
    """Clean torque at the samples for one pulse width an interval, from rest, N·m.

    It uses scipy's discretisation for a held input, so that the simulation does not depend on `identify.dynamics`.
    """
    from scipy.signal import cont2discrete, lfilter

    transfer = ([1.0], [TIME_CONSTANT_S**2, 2 * DAMPING * TIME_CONSTANT_S, 1.0])
    b, a = cont2discrete(transfer, 1.0 / sample_rate_hz, method="zoh")[:2]  # pyright: ignore
    each = round(sample_rate_hz / pulse_rate_hz)
    return np.asarray(lfilter(np.ravel(b), np.ravel(a), np.repeat(recruitment(width_us), each)))


def prbs(bits: int = 7, hold: int = 5, level_us: float = TOP_US) -> np.ndarray:
    """Maximum-length sequence of 2^bits - 1 levels, 0 or `level_us`, each held for `hold` pulses.

    The feedback taps are those of primitive polynomials, such as x⁷ + x⁶ + 1.
    """
    taps = {5: (5, 3), 6: (6, 5), 7: (7, 6), 8: (8, 6, 5, 4)}[bits]
    state, levels = [1] * bits, []
    for _ in range(2**bits - 1):
        levels.append(state[-1])
        new = 0
        for tap in taps:
            new ^= state[tap - 1]
        state = [new, *state[:-1]]
    return np.repeat(np.array(levels, float) * level_us, hold)


def ramp(seconds: float = 10.0, top_us: float = TOP_US, pulse_rate_hz: float = 40.0) -> np.ndarray:
    """Triangle 0 to top to 0."""
    half = round(seconds * pulse_rate_hz / 2)
    up = np.linspace(0.0, top_us, half, endpoint=False)
    return np.r_[up, top_us - up]


def multilevel(seconds: float = 15.0, hold: int = 20, top_us: float = TOP_US, seed: int = 0) -> np.ndarray:
    """Random levels over the whole range, each held for `hold` pulses; for validation only."""
    size = round(seconds * 40.0)
    levels = np.random.default_rng(seed).uniform(0.0, top_us, size // hold + 1)
    return np.repeat(levels, hold)[:size]


def protocol() -> tuple[np.ndarray, list[str]]:
    """Width and segment name of each pulse: rest, PRBS, rest, ramp, rest, validate, rest (48 s)."""
    rest = np.zeros
    parts = [
        ("rest", rest(40)),
        ("prbs", prbs()),
        ("rest", rest(200)),
        ("ramp", ramp()),
        ("rest", rest(120)),
        ("validate", multilevel()),
        ("rest", rest(40)),
    ]
    return np.concatenate([part for _, part in parts]), [name for name, part in parts for _ in part]

"""Tests for noise in the residual: its correlation with itself, u, u² and y, with bands of a known false-alarm rate.

With a band of 1.96/√N at each lag, a false alarm at any lag is far more frequent than 5 %. Here the band of a function
is the 95 % quantile of its largest value over all lags, found by simulating noise for this record: its length, gaps and
input.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid, ends_of, runs
from stimrig.identify.estimation.samples import block_means
from stimrig.identify.noise import WHITE_AND_SLOW, profile

LAGS = 25
DRAWS = 1500
LEVEL = 0.95
WORDS = {
    "residual": "The residual is correlated with itself: the noise is slow, or the model lacks dynamics.",
    "u": "The residual is correlated with the pulse width: delay, threshold or dynamics are wrong.",
    "u2": "The residual is correlated with the squared pulse width: the recruitment curve or the dynamics are wrong.",
    "y": "The residual is correlated with the torque: gain or speed change with the level, or the torque saturates.",
}


def correlation_tests(grid: Grid, residual_nm: np.ndarray) -> dict[str, Any]:
    """Correlation functions of a residual (at the record's samples) on the grid of pulses, with bands.

    Returns `lags_s`; `tests`: one for each of residual, u, u2, y with `values`, `band`, `passed`, `largest`, `words`;
    `false_alarm_rate` of each function; `innovations`: whether the cross-correlations are those of the residual without
    its slow noise.
    """
    known = (grid.count > 0) & ~grid.doubted
    residual = np.where(known, block_means(grid, residual_nm), 0.0)
    residual = residual - residual[known].mean()
    torque = np.where(known, grid.torque_nm, 0.0)
    white, ar1 = _innovations(residual, known, grid.step_s)
    # At the times at which the pulses truly came: late pulses on even slots would spread a correlation over lags.
    width = grid.pulse_width_us
    signals = {"u": grid.interval_means(width), "u2": grid.interval_means(width**2), "y": torque - residual}
    filtered = {name: _filtered(signal, ar1, known) for name, signal in signals.items()}
    functions = {"residual": _auto(residual)} | {name: _cross(white, signal) for name, signal in filtered.items()}
    bands = _bands(filtered, known)
    tests = []
    for name, values in functions.items():
        largest = float(np.max(np.abs(values)))
        tests.append(
            {
                "with": name,
                "values": values,
                "band": bands[name],
                "largest": largest,
                "at_lag_s": float(np.argmax(np.abs(values)) + (name == "residual")) * grid.step_s,
                "passed": largest <= bands[name],
                "words": WORDS[name],
            }
        )
    return {
        "lags_s": np.arange(LAGS + 1) * grid.step_s,
        "tests": tests,
        "false_alarm_rate": 1.0 - LEVEL,
        "innovations": ar1 > 0.0,
    }


def _innovations(residual: np.ndarray, known: np.ndarray, step_s: float) -> tuple[np.ndarray, float]:
    """The residual without slow noise: cross-correlations of coloured noise become large by chance."""
    noise, _ = profile(residual, ends_of(runs(known)), WHITE_AND_SLOW.of_steps(step_s))
    lag_one = noise.ar1 * noise.share
    if abs(lag_one) < 0.08:
        return residual, 0.0
    return _filtered(residual, lag_one, known), lag_one


def _filtered(signal: np.ndarray, ar1: float, known: np.ndarray) -> np.ndarray:
    values = np.where(known, signal - signal[known].mean(), 0.0)
    out = values.copy()
    out[1:] -= ar1 * values[:-1]
    return np.where(known, out - out[known].mean(), 0.0)


def _auto(residual: np.ndarray) -> np.ndarray:
    power = max(float(residual @ residual), 1e-30)
    return np.array([residual[lag:] @ residual[:-lag] / power for lag in range(1, LAGS + 1)])


def _cross(residual: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Correlation of the residual with the signal `lag` steps earlier, lags 0 to LAGS."""
    size = max(float(np.linalg.norm(residual) * np.linalg.norm(signal)), 1e-30)
    return np.array([residual[lag:] @ signal[: residual.size - lag] / size for lag in range(LAGS + 1)])


def _bands(signals: dict[str, np.ndarray], known: np.ndarray) -> dict[str, float]:
    """95 % quantile of the largest value over lags, for simulated white noise (the same draws every time)."""
    rng = np.random.default_rng(20240229)
    size = known.size
    padded = 1 << int(np.ceil(np.log2(size + LAGS + 1)))
    spectra = {name: np.conj(np.fft.rfft(signal, padded)) for name, signal in signals.items()}
    norms = {name: np.linalg.norm(signal) for name, signal in signals.items()}
    largest: dict[str, list[np.ndarray]] = {name: [] for name in ["residual", *signals]}
    for _ in range(DRAWS // 100):
        noise = np.where(known, rng.standard_normal((100, size)), 0.0)
        noise -= np.where(known, noise.sum(axis=1, keepdims=True) / known.sum(), 0.0)
        spectrum = np.fft.rfft(noise, padded, axis=1)
        length = np.linalg.norm(noise, axis=1, keepdims=True)
        auto = np.fft.irfft(np.abs(spectrum) ** 2, padded, axis=1)[:, 1 : LAGS + 1] / length**2
        largest["residual"].append(np.max(np.abs(auto), axis=1))
        for name, other in spectra.items():
            cross = np.fft.irfft(spectrum * other, padded, axis=1)[:, : LAGS + 1] / (length * max(norms[name], 1e-30))
            largest[name].append(np.max(np.abs(cross), axis=1))
    return {name: float(np.quantile(np.concatenate(values), LEVEL)) for name, values in largest.items()}

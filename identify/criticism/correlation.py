"""Tests for noise in the residual: its correlation with itself, u, u² and y, with bands of a known false-alarm rate.

With a band of 1.96/√N at each lag, a false alarm at any lag is far more frequent than 5 %. Here the band of a function
is a quantile of its largest value over all lags, found by simulating noise for this record: its length, gaps, input and
what a fit takes from it. It is the quantile at which any of the four leaves its band in 5 % of records. What the
model's uncertainty leaves in the residual is no sign of a wrong structure, and is removed first.
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
LEAST_SLOW = 0.08
"""Correlation of neighbours from which noise counts as slow."""
NEGLIGIBLE = 0.1
"""An uncertainty of less than so many standard deviations of the noise is ignored."""
WORDS = {
    "residual": "The residual is correlated with itself: the noise may be slow, or the model may lack dynamics.",
    "u": "The residual is correlated with the pulse width: delay, threshold or dynamics may be wrong.",
    "u2": "The residual is correlated with the squared pulse width: recruitment curve or dynamics may be wrong.",
    "y": "The residual is correlated with the torque: gain or speed may change with the level, or the torque saturate.",
}


def correlation_tests(
    grid: Grid, residual_nm: np.ndarray, fitted: np.ndarray, directions_nm: np.ndarray
) -> dict[str, Any]:
    """Correlation functions of a residual (at the record's samples) on the grid of pulses, with bands.

    `fitted`: bool, shape (K,): intervals that the model was fitted on. `directions_nm`, shape (K, D): as
    `prediction_directions`. The functions are those of the residual without what the model's uncertainty adds.

    Returns `lags_s`; `tests`: one for each of residual, u, u2, y with `values`, `band`, `passed`, `largest`, `words`;
    `false_alarm_rate` of all tests together; `innovations`: whether the cross-correlations are those of the residual
    without its slow noise.
    """
    known = (grid.count > 0) & ~grid.doubted
    error = np.where(known, block_means(grid, residual_nm), 0.0)
    # The last direction is that of the zero, which may have been set anew.
    zero = np.full(grid.size, 1e3 * np.std(error[known]))
    directions = np.where(known, np.c_[directions_nm, zero].T, 0.0)
    residual, absorbed = _without_uncertainty(error, directions, known, fitted)
    noise, _ = profile(residual, ends_of(runs(known)), WHITE_AND_SLOW.of_steps(grid.step_s))
    slow, white = noise.ar1 * noise.share, residual
    if innovations := slow >= LEAST_SLOW:  # cross-correlations of coloured noise become large by chance
        rows = _filtered(np.vstack([error, directions]), slow, known)
        white, _ = _without_uncertainty(rows[0], rows[1:], known, fitted)
    # At the times at which the pulses truly came: late pulses on even slots would spread a correlation over lags.
    width, torque = grid.pulse_width_us, np.where(known, grid.torque_nm, 0.0)
    signals = {"u": grid.interval_means(width), "u2": grid.interval_means(width**2), "y": torque - error}
    signals = {name: _filtered(signal, slow * innovations, known) for name, signal in signals.items()}
    functions = _functions(white, signals) | _functions(residual, {})
    tests, bands = [], _bands(signals, known, absorbed)
    for name, words in WORDS.items():
        values, place = functions[name], int(np.argmax(np.abs(functions[name])))
        largest, at_lag_s = float(np.abs(values[place])), float(place + (name == "residual")) * grid.step_s
        test = {"with": name, "values": values, "band": bands[name], "largest": largest, "at_lag_s": at_lag_s}
        tests.append(test | {"passed": largest <= bands[name], "words": words})
    lags_s = np.arange(LAGS + 1) * grid.step_s
    return {"lags_s": lags_s, "tests": tests, "false_alarm_rate": 1.0 - LEVEL, "innovations": innovations}


def _without_uncertainty(
    error: np.ndarray, directions: np.ndarray, known: np.ndarray, fitted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the error without what the model's uncertainty adds, and what a fit takes from noise, shape (R, K).

    Along the directions, shape (D, K), the error of a correct model is less than the noise on fitted rows, by what the
    fit took: there it is removed. On other rows it is more, and is scaled down to the size of the noise.
    """
    parts = []
    for rows, was_fitted in ((known & fitted, True), (known & ~fitted, False)):
        sizes, axes = np.linalg.svd(directions[:, rows], full_matrices=False)[1:]
        parts.append((rows, was_fitted, sizes, axes))
    noise_sd = float(np.std(error[known]))
    for _ in range(3):  # the less noise, the more directions count
        squares, freedom = 0.0, 1e-9
        for rows, _, sizes, axes in parts:
            axes = axes[sizes > NEGLIGIBLE * noise_sd]
            squares += float(np.sum((error[rows] - (axes @ error[rows]) @ axes) ** 2))
            freedom += rows.sum() - len(axes)
        noise_sd = np.sqrt(squares / freedom)
    corrected, absorbed = error.copy(), np.zeros((0, error.size))
    for rows, was_fitted, sizes, axes in parts:
        counted = sizes > NEGLIGIBLE * noise_sd
        axes, share = axes[counted], 1.0 if was_fitted else 1.0 - 1.0 / np.hypot(1.0, sizes[counted] / noise_sd)
        corrected[rows] -= (share * (axes @ error[rows])) @ axes
        if was_fitted:
            absorbed = np.zeros((len(axes), error.size))
            absorbed[:, rows] = axes
    return corrected, absorbed


def _filtered(signal: np.ndarray, ar1: float, known: np.ndarray) -> np.ndarray:
    """Signals, shape (..., K), without slow noise of this correlation of neighbours, and without their mean."""
    values = _centred(signal, known)
    out = values.copy()
    out[..., 1:] -= ar1 * values[..., :-1]
    return _centred(out, known)


def _centred(rows: np.ndarray, known: np.ndarray) -> np.ndarray:
    return np.where(known, rows - rows[..., known].mean(axis=-1, keepdims=True), 0.0)


def _functions(rows: np.ndarray, signals: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Correlations of rows, shape (..., K), with themselves 1 to LAGS steps earlier, and with signals 0 to LAGS."""
    padded = 1 << int(np.ceil(np.log2(rows.shape[-1] + LAGS + 1)))
    spectrum = np.fft.rfft(rows, padded)
    length = np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-30)
    functions = {"residual": np.fft.irfft(np.abs(spectrum) ** 2, padded)[..., 1 : LAGS + 1] / length**2}
    for name, signal in signals.items():
        products = np.fft.irfft(spectrum * np.conj(np.fft.rfft(signal, padded)), padded)[..., : LAGS + 1]
        functions[name] = products / (length * max(float(np.linalg.norm(signal)), 1e-30))
    return functions


def _bands(signals: dict[str, np.ndarray], known: np.ndarray, absorbed: np.ndarray) -> dict[str, float]:
    """Bands that any function leaves in 5 % of records, for simulated white noise (the same draws every time).

    Each is the same quantile of the largest value over lags. `absorbed`: what a fit takes from noise, shape (R, K).
    """
    rng, draws = np.random.default_rng(20240229), []
    for _ in range(DRAWS // 100):
        noise = _centred(rng.standard_normal((100, known.size)), known)
        functions = _functions(noise - (noise @ absorbed.T) @ absorbed, signals)
        draws.append([np.max(np.abs(values), axis=1) for values in functions.values()])
    largest = np.concatenate(draws, axis=1)
    rank = np.argsort(np.argsort(largest, axis=1), axis=1).max(axis=0) / (DRAWS - 1)
    bands = np.quantile(largest, np.quantile(rank, LEVEL), axis=1)
    return dict(zip(["residual", *signals], bands.tolist(), strict=True))

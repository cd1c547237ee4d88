"""Tests of a residual whose false alarms are what they say, on the grid of pulses.

Each compares with chi-square after what the fit took out of the residual is accounted for: bands for raw residuals are
too narrow or too wide (a published package's 1.96/√(2N-1) alarms 16 % of the time at a nominal 5).
"""

from __future__ import annotations

from itertools import pairwise
from math import erfc, sqrt
from typing import Any

import numpy as np

from identify.estimation.joint import Fitted
from identify.noise.level import whitened

LAGS = 20
ALARM = 0.01


def chi_square_p(statistic: float, freedom: float) -> float:
    """P(chi² > statistic), by Wilson and Hilferty's cube root: right to 1e-3 where it matters here."""
    if statistic <= 0:
        return 1.0
    z = ((statistic / freedom) ** (1 / 3) - (1 - 2 / (9 * freedom))) / sqrt(2 / (9 * freedom))
    return 0.5 * erfc(z / sqrt(2))


def residual_tests(fitted: Fitted) -> dict[str, Any]:
    """Whiteness, and structure that the model's own structure can't give.

    Returns
    -------
    dict
        `whiteness`: Ljung-Box over 20 lags on the innovations. `structure`: share of the residual explained by six
        signals of missing physics (drift, gain drift, output squared, rate, direction, onset), what the model itself
        explains taken out first. Each with statistic, freedom, p_value, passed.
    """
    setup = fitted.problem.setup
    start, stop = setup.stretches
    white = whitened(fitted.residual_nm[None, :] / setup.spread, setup.stretches, fitted.noise)[0]
    if not fitted.rms_nm > 1e-12 * setup.scale_nm:
        return {}
    edges = np.r_[0, np.cumsum(stop - start)]
    power = float(white @ white)
    lags = min(LAGS, max(int(np.min(stop - start)) - 2, 1), white.size // 4)
    statistic = 0.0
    for lag in range(1, lags + 1):
        pairs = [white[a + lag : b] @ white[a : b - lag] for a, b in pairwise(edges) if b - a > lag]
        statistic += (float(sum(pairs)) / power) ** 2 / (white.size - lag)
    statistic *= white.size * (white.size + 2)
    # What was estimated of the noise takes a freedom each; the three numbers of the dynamics hardly any.
    freedom = lags - (0 if fitted.noise.is_white else 2)
    return {
        "whiteness": _verdict(statistic, max(freedom, 1)) | {"lags": lags},
        "structure": _structure(fitted, white),
    }


def _structure(fitted: Fitted, white: np.ndarray) -> dict[str, Any]:
    problem, setup = fitted.problem, fitted.problem.setup
    mean = np.nan_to_num(setup.target_nm - fitted.residual_nm)
    drive = fitted.physical[problem.coefficients] @ setup.design
    time = np.linspace(-1.0, 1.0, setup.grid.size)
    rate = np.gradient(mean)
    signals = np.stack([time, time * mean, mean**2, np.abs(rate), np.abs(drive - mean) * mean, time * drive])
    scale = np.linalg.norm(signals, axis=1)
    signals = signals[scale > 0] / scale[scale > 0][:, None]
    extra = whitened(signals / setup.spread, setup.stretches, fitted.noise)
    own = whitened(fitted.slopes / setup.spread, setup.stretches, fitted.noise)
    # The penalised fit takes out less than a projection: the same smoother is applied to the signals.
    size = np.sqrt(np.maximum(np.diag(fitted.hessian), 1e-300))
    scaled = fitted.hessian / size[:, None] / size[None, :] + 1e-10 * np.eye(size.size)
    smoothed = (np.linalg.solve(scaled, (own @ extra.T) / size[:, None]) / size[:, None]).T @ own
    left = extra - smoothed
    # Under the null the score left·r has about the variance left·left (the smoother is nearly a projection).
    values, vectors = np.linalg.eigh(left @ left.T)
    kept = values > 1e-6 * max(float(values.max()), 1e-300)
    part = (vectors.T @ (left @ white))[kept] / np.sqrt(values[kept])
    return _verdict(float(part @ part), max(int(kept.sum()), 1))


def _verdict(statistic: float, freedom: int) -> dict[str, Any]:
    p = chi_square_p(statistic, freedom)
    return {"statistic": statistic, "freedom": freedom, "p_value": p, "passed": bool(p >= ALARM)}

"""Tests of a residual whose false alarms are what they say, on the grid of pulses.

Each compares with chi-square after what the fit took out of the residual is accounted for: bands for raw residuals are
too narrow or too wide (a published package's 1.96/√(2N-1) alarms 16 % of the time at a nominal 5).
"""

from __future__ import annotations

from itertools import pairwise
from math import erfc, sqrt
from typing import Any

import numpy as np

from identify.estimation.projected import Solution
from identify.noise.ar1 import whiten

LAGS = 20
ALARM = 0.01


def chi_square_p(statistic: float, freedom: float) -> float:
    """P(chi² > statistic), by Wilson and Hilferty's cube root: right to 1e-3 where it matters here."""
    if statistic <= 0:
        return 1.0
    z = ((statistic / freedom) ** (1 / 3) - (1 - 2 / (9 * freedom))) / sqrt(2 / (9 * freedom))
    return 0.5 * erfc(z / sqrt(2))


def residual_tests(solution: Solution) -> dict[str, Any]:
    """Whiteness, and structure that a Hammerstein model can't give.

    Returns
    -------
    dict
        `whiteness`: Ljung-Box over 20 lags on the innovations. `structure`: share of the residual explained by six
        signals of missing physics (drift, gain drift, output squared, rate, direction, onset), what the model itself
        explains taken out first. Each with statistic, freedom, p_value, passed.
    """
    problem = solution.problem
    white = whiten(solution.residual_nm, problem.stretches, solution.ar1)
    lengths = [s.stop - s.start for s in problem.stretches]
    edges = np.r_[0, np.cumsum(lengths)]
    power = float(white @ white)
    if not power > 1e-24 * white.size:
        return {}
    lags = min(LAGS, max(min(lengths) - 2, 1), white.size // 4)
    statistic = 0.0
    for lag in range(1, lags + 1):
        pairs = [white[a + lag : b] @ white[a : b - lag] for a, b in pairwise(edges) if b - a > lag]
        statistic += (float(sum(pairs)) / power) ** 2 / (white.size - lag)
    statistic *= white.size * (white.size + 2)
    # An AR(1) parameter that was estimated takes one freedom; the three numbers of the dynamics hardly any.
    freedom = lags - (1 if solution.ar1 else 0)
    return {
        "whiteness": _verdict(statistic, max(freedom, 1)) | {"lags": lags},
        "structure": _structure(solution, white),
    }


def _structure(solution: Solution, white: np.ndarray) -> dict[str, Any]:
    problem, grid = solution.problem, solution.problem.grid
    fitted = (
        solution.fitted_nm - np.median(solution.fitted_nm[grid.pulse_width_us == 0])
        if np.any(grid.pulse_width_us == 0)
        else solution.fitted_nm
    )
    time = np.linspace(-1.0, 1.0, grid.size)
    rate = np.gradient(fitted)
    drive = problem.drive @ solution.coefficients[: problem.basis.size]
    signals = np.stack(
        [time, time * fitted, fitted**2, np.abs(rate), np.abs(drive - fitted) * fitted, time * drive], axis=1
    )
    scale = np.linalg.norm(signals, axis=0)
    signals = signals[:, scale > 0] / scale[scale > 0]
    extra = whiten(signals, problem.stretches, solution.ar1)
    own = whiten(np.concatenate([solution.columns, solution.slopes], axis=1), problem.stretches, solution.ar1)
    # The penalised fit takes out less than a projection: the same smoother is applied to the signals.
    size = np.sqrt(np.maximum(np.diag(solution.gram), 1e-300))
    scaled = solution.gram / size[:, None] / size[None, :] + 1e-10 * np.eye(size.size)
    smoothed = own @ (np.linalg.solve(scaled, (own.T @ extra) / size[:, None]) / size[:, None])
    left = extra - smoothed
    variance = solution.variance
    # Under the null the score left'r has variance about variance * left'left (the smoother is nearly a projection).
    gram = left.T @ left
    score = left.T @ white
    values, vectors = np.linalg.eigh(gram)
    kept = values > 1e-6 * max(float(values.max()), 1e-300)
    part = (vectors.T @ score)[kept] / np.sqrt(values[kept])
    return _verdict(float(part @ part) / variance, max(int(kept.sum()), 1))


def _verdict(statistic: float, freedom: int) -> dict[str, Any]:
    p = chi_square_p(statistic, freedom)
    return {"statistic": statistic, "freedom": freedom, "p_value": p, "passed": bool(p >= ALARM)}

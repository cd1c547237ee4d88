"""Polynomial NARX, the black box of the paper's introduction (reference 6), for comparison.

Terms are products of past torques and pulse widths up to the third degree. They are chosen one at a time by the share
of the error that they explain (orthogonal forward regression with the error reduction ratio, Billings 1988), until BIC
rises. Such models predict one step ahead very well, but may drift or diverge in a free run; only the free run counts.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import Discrete, run_narx
from stimrig.identify.estimation.finish import finish_discrete
from stimrig.identify.estimation.samples import fitted_rows
from stimrig.identify.methods import Method
from stimrig.identify.methods.common import quiet_level, with_past
from stimrig.identify.model import Model
from stimrig.identify.recruitment import Curve
from stimrig.identify.recruitment.bases import SplineBasis

MAX_TERMS = 14


def fit(grid: Grid, fit_on: tuple[str, ...] | None, **options: Any) -> Model:
    """Fit on the named segments, or on all that may be fitted."""
    rows = fitted_rows(grid, fit_on)
    torque_lags, width_lags = int(options.get("torque_lags", 2)), int(options.get("width_lags", 3))
    baseline = quiet_level(grid)
    torque_scale = float(np.std(grid.torque_nm[rows])) or 1.0
    width_scale = float(np.max(grid.pulse_width_us)) or 1.0
    torque = (np.nan_to_num(grid.torque_nm) - baseline) / torque_scale
    width = grid.interval_means(grid.pulse_width_us) / width_scale
    variables = [(0, lag) for lag in range(1, torque_lags + 1)] + [(1, lag) for lag in range(1, width_lags + 1)]
    degree = int(options.get("degree", 3))
    terms = [c for d in range(1, degree + 1) for c in combinations_with_replacement(range(len(variables)), d)]
    used = with_past(rows, max(torque_lags, width_lags))
    lagged = np.stack([np.roll((torque, width)[kind], lag) for kind, lag in variables], axis=1)[used]
    candidates = np.stack([np.prod(lagged[:, list(term)], axis=1) for term in terms], axis=1)
    chosen, weights = forward_regression(candidates, torque[used], int(options.get("terms", MAX_TERMS)))
    recipe = {
        "variables": variables,
        "terms": [list(terms[i]) for i in chosen],
        "weights": [float(w) for w in weights],
        "torque_scale_nm": torque_scale,
        "width_scale_us": width_scale,
        "baseline_nm": baseline,
    }
    curve = steady_curve(recipe, float(np.max(grid.pulse_width_us)))
    block = Discrete((1.0,), (1.0,), 1, grid.step_s, float(np.mean(grid.fraction)))
    reasons = [f"{len(chosen)} of {len(terms)} terms: " + ", ".join(name_of(terms[i], variables) for i in chosen)]
    return finish_discrete(METHOD.id, grid, rows, block, curve, reasons, {"narx": recipe})


METHOD = Method(
    "narx",
    "Polynomial NARX of degree 3 by orthogonal forward regression: a black box, for comparison.",
    {
        "torque_lags": "number of past torques (default: 2)",
        "width_lags": "number of past pulse widths (default: 3)",
        "degree": "highest degree (default: 3)",
        "terms": f"largest number of terms (default: {MAX_TERMS})",
    },
    fit,
)


def name_of(term: tuple[int, ...], variables: list[tuple[int, int]]) -> str:
    """A term as text, such as y[k-1]·u[k-2]."""
    return "·".join(f"{'yu'[variables[v][0]]}[k-{variables[v][1]}]" for v in term)


def forward_regression(candidates: np.ndarray, target: np.ndarray, max_terms: int) -> tuple[list[int], np.ndarray]:
    """Columns in the order of the error that they explain, until BIC rises, and their weights."""
    rest, residual, chosen = candidates.copy(), target.copy(), []
    size = target.size
    best = size * np.log(max(float(residual @ residual) / size, 1e-300))
    floor = 1e-10 * (rest**2).sum(axis=0)
    for _ in range(max_terms):
        power = (rest**2).sum(axis=0)
        share = np.where(power > floor, (rest.T @ residual) ** 2 / np.maximum(power, 1e-300), 0.0)
        pick = int(np.argmax(share))
        trial = max(float(residual @ residual) - float(share[pick]), 1e-300)
        bic = size * np.log(trial / size) + (len(chosen) + 1) * np.log(size)
        if bic >= best:
            break
        best, direction = bic, rest[:, pick] / np.sqrt(power[pick])
        chosen.append(pick)
        residual = residual - direction * (direction @ residual)
        rest = rest - direction[:, None] * (direction @ rest)
    weights = np.linalg.lstsq(candidates[:, chosen], target, rcond=None)[0] if chosen else np.zeros(0)
    return chosen, weights


def steady_curve(recipe: dict[str, Any], largest_us: float) -> Curve:
    """Steady-state torque of the free run for each pulse width, used as recruitment curve."""
    basis = SplineBasis(np.linspace(0.0, largest_us, 13))
    level = np.linspace(0.0, largest_us, 41)
    torque = np.array([run_narx(recipe, np.full(400, u))[-1] for u in level])
    design = basis.design(level)
    gram = design.T @ design + 1e-9 * np.eye(basis.size)
    return Curve(basis, np.linalg.solve(gram, design.T @ torque))

"""Free run of a polynomial NARX model."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.linear import Discrete
from stimrig.identify.dynamics.pulse_grid import Grid

LIMIT = 20.0
"""Scaled torque at which a diverging free run is stopped."""


def run(recipe: dict[str, Any], width_us: np.ndarray) -> np.ndarray:
    """Free run from rest for one pulse width per interval, N·m above the baseline; limited if it diverges."""
    variables, terms, weights = recipe["variables"], recipe["terms"], recipe["weights"]
    width = (np.asarray(width_us, float) / recipe["width_scale_us"]).tolist()
    lead = max((lag for _, lag in variables), default=1)
    width, torque = [0.0] * lead + width, [0.0] * (lead + len(width))
    for k in range(lead, len(width)):
        value = [(torque if kind == 0 else width)[k - lag] for kind, lag in variables]
        total = 0.0
        for term, weight in zip(terms, weights, strict=True):
            product = weight
            for v in term:
                product *= value[v]
            total += product
        torque[k] = min(max(total, -LIMIT), LIMIT)
    return np.array(torque[lead:]) * recipe["torque_scale_nm"]


def at_samples(recipe: dict[str, Any], grid: Grid, centre: float) -> np.ndarray:
    """Free run at the record's samples, with its baseline, N·m, shape (N,)."""
    means = run(recipe, grid.held(grid.pulse_width_us)) + recipe["baseline_nm"]
    return Discrete((1.0,), (1.0,), 0, grid.step_s, centre).between(grid, means)

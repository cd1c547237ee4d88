"""Curves of the free effects of a fit, with bands, and one sentence for each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from stimrig.identify.effects import find_effect
from stimrig.identify.effects.base import Form, Shape
from stimrig.identify.estimation.solve import Fitted
from stimrig.identify.estimation.uncertainty import square_root

DRAWS = 200
PERCENTILES = 2.5, 97.5


def shape_of(fitted: Fitted, index: int, matrix: np.ndarray) -> dict[str, Any] | None:
    """Compute the curves of one effect of a fit; None for an effect that is not free.

    `index`: of the effect in `fitted.problem.chosen`. `matrix`: covariance of all parameters in their units. Returns
    `place`, `driven_by`, `words`, `driver`, `at`, `effect`, and `lines`: by name `value`, `lower` and `upper` (95 % of
    draws of the effect's parameters), each of shape (n,).
    """
    chosen = fitted.problem.chosen[index]
    shape = find_effect(chosen.effect).shape
    if shape is None:
        return None
    places = list(chosen.places)
    values = fitted.physical[places]
    names = [p.name for p in chosen.parameters]
    fitted_shape = shape(chosen.form, dict(zip(names, values.tolist(), strict=True)))
    normal = np.random.default_rng(0).standard_normal((DRAWS, len(places)))
    draws = values + normal @ square_root(matrix[np.ix_(places, places)])
    bounds = np.array([(p.lower, p.upper) for p in chosen.parameters]).T
    every = [_lines(shape, chosen.form, names, row) for row in np.clip(draws, *bounds)]
    lines = {}
    for name, line in fitted_shape.lines.items():
        lower, upper = np.percentile([drawn_lines[name] for drawn_lines in every], PERCENTILES, axis=0)
        lines[name] = {"value": line.tolist(), "lower": lower.tolist(), "upper": upper.tolist()}
    description = {key: getattr(fitted_shape, key) for key in ("place", "driven_by", "words", "driver", "effect")}
    return description | {"at": fitted_shape.at.tolist(), "lines": lines}


def _lines(shape: Any, form: Form, names: list[str], row: np.ndarray) -> Mapping[str, np.ndarray]:
    drawn_shape: Shape = shape(form, dict(zip(names, row.tolist(), strict=True)))
    return drawn_shape.lines

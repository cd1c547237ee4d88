"""The fit statistics of a fitted candidate: on fitted rows, and on held-out rows or by cross-validation."""

from __future__ import annotations

from typing import Any

from identify.estimation.band_effect import predict_fitted
from identify.estimation.cross_validation import held_out_change
from identify.estimation.fit_statistics import fit_statistics, white_sd
from identify.estimation.joint import Fitted


def evaluate(fitted: Fitted) -> dict[str, Any]:
    """The key `fit` of MODEL.json: errors, best-fit %, and the best fit that the noise allows."""
    setup = fitted.problem.setup
    grid = setup.grid
    predicted = predict_fitted(fitted)
    noise = white_sd(grid, predicted, fitted.noise.sd_nm, fitted.freedom, fitted.noise.is_white)
    change = None if grid.record.has_held_out else held_out_change(fitted)
    found = fit_statistics(grid, setup.fitted, predicted, noise, change)
    return found | {"log_evidence": fitted.log_evidence, "log_likelihood": fitted.log_likelihood}

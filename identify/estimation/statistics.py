"""Errors of a fitted candidate at the record's samples: fitted rows, held-out rows, or blocked cross-validation."""

from __future__ import annotations

from typing import Any

from identify.estimation.cross_validation import held_out_change
from identify.estimation.figures import figures, white_sd
from identify.estimation.joint import Fitted
from identify.estimation.tremor import predict_fitted


def statistics(fitted: Fitted) -> dict[str, Any]:
    """What MODEL.json tells under `fit`: errors, best-fit %, and the ceilings that noise sets."""
    setup = fitted.problem.setup
    grid = setup.grid
    predicted = predict_fitted(fitted)
    noise = white_sd(grid, predicted, fitted.noise.sd_nm, fitted.freedom, fitted.noise.is_white)
    change = None if grid.record.has_held_out else held_out_change(fitted)
    found = figures(grid, setup.fitted, predicted, noise, change)
    return found | {"log_evidence": fitted.log_evidence, "log_likelihood": fitted.log_likelihood}

"""Maximum likelihood: recruitment and dynamics in one joint estimate on all segments, under the noise that is there.

Beyond the paper: its cost (12) is minimised as it stands, on output error, over recruitment and dynamics together,
instead of one after the other; noise may be correlated; the spline's smoothness is chosen from the data.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from identify.finish import finish
from identify.grid import Grid
from identify.methods.common import fitted_rows
from identify.model import Model
from identify.noise import noise_evidence
from identify.projection import Solution, begins_at_rest, designed, pilot_solution, search
from identify.recruitment.knots import KNOTS


class MaximumLikelihood:
    """The default method."""

    id = "maximum-likelihood"
    summary = "Joint estimate of recruitment spline and second-order dynamics by variable projection on all segments."
    options: Mapping[str, str] = MappingProxyType({"knots": "how many knots the spline has (31)"})

    def fit(self, grid: Grid, fit_on: tuple[str, ...] | None, **options: Any) -> Model:
        """Fit; see `identify.fit`."""
        solution, delta_bic = estimate(grid, fitted_rows(grid, fit_on), knots=int(options.get("knots", KNOTS)))
        return finish(self.id, solution, delta_bic)


METHOD = MaximumLikelihood()


def estimate(grid: Grid, rows: np.ndarray, knots: int = KNOTS, delay_s: float | None = None) -> tuple[Solution, float]:
    """The solution, and the evidence for AR(1) over white noise (ΔBIC)."""
    problem, start = designed(pilot_solution(grid, rows, begins_at_rest(grid), delay_s), knots)
    solution = search(problem, start)
    ar1, delta_bic = noise_evidence(solution.residual_nm, problem.stretches)
    for _ in range(3):
        if delta_bic <= 0:
            break
        solution = search(problem, solution.linear, ar1=ar1)
        before = ar1
        ar1, delta_bic = noise_evidence(solution.residual_nm, problem.stretches)
        if abs(ar1 - before) < 0.01:
            break
    return solution, delta_bic

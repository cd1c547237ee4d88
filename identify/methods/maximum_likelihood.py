"""Maximum likelihood: recruitment and dynamics in one joint estimate on all segments, under the noise that is there.

Beyond the paper: its cost (12) is minimised as it stands, on output error, over recruitment and dynamics together,
instead of one after the other; noise may be correlated; the spline's smoothness is chosen from the data.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from identify.dynamics.pulse_grid import Grid
from identify.errors import BadRequest
from identify.estimation.finish import finish
from identify.estimation.projected import Solution, begins_at_rest, designed, pilot_solution, search
from identify.methods.support.common import fitted_rows, flag, order_option
from identify.model import Model
from identify.noise.ar1 import noise_evidence
from identify.recruitment.knots import KNOTS

ROUNDING = 2e-5
"""Share of the torque's range below which a residual is not noise."""


class MaximumLikelihood:
    """The default method."""

    id = "maximum-likelihood"
    summary = "Joint estimate of recruitment spline and second-order dynamics by variable projection on all segments."
    options: Mapping[str, str] = MappingProxyType(
        {
            "recruitment": "spline (default, (8)), power-series (6) or sigmoid (30)",
            "monotone": "true: the spline never falls (false)",
            "knots": "how many knots the spline has (19, or 31 where the curve is steep)",
            "power": "order of the power series (by BIC)",
            "delay_s": "a delay that is known, s (estimated)",
            "order": "second-order (default), auto, or l,n,d of equations (1) to (3)",
        }
    )

    def fit(self, grid: Grid, fit_on: tuple[str, ...] | None, **options: Any) -> Model:
        """Fit; see `identify.fit`."""
        rows = fitted_rows(grid, fit_on)
        order = order_option(options.get("order", "second-order"))
        knots = int(options["knots"]) if "knots" in options else None
        if order != "second-order":
            from identify.methods.two_stage import general

            return general(self.id, grid, rows, rows, 8, knots or KNOTS, order)
        delay_s = float(options["delay_s"]) if "delay_s" in options else None
        kind = str(options.get("recruitment", "spline"))
        solution, delta_bic = estimate(grid, rows, knots, delay_s)
        reasons = []
        if kind == "spline":
            reasons.append(
                f"spline of {solution.problem.basis.size} coefficients, smoothed to {solution.freedom:.1f} effective"
            )
            if flag(options.get("monotone", False), "monotone"):
                from identify.methods.support.alternatives import monotone

                solution = monotone(solution)
                reasons.append("recruitment held monotone")
        else:
            solution, reason = _other(kind, solution, options)
            delta_bic = noise_evidence(solution.residual_nm, solution.problem.stretches)[1]
            reasons.append(reason)
        return finish(self.id, solution, delta_bic, [*reasons, *_why(solution, delta_bic)])


METHOD = MaximumLikelihood()


def _other(kind: str, solution: Solution, options: Mapping[str, Any]) -> tuple[Solution, str]:
    from identify.methods.support.alternatives import power_series, sigmoid

    if kind == "power-series":
        return power_series(solution, int(options["power"]) if "power" in options else None)
    if kind == "sigmoid":
        return sigmoid(solution), "sigmoid (30)"
    raise BadRequest(f"recruitment {kind!r}", place="recruitment", mend="Give spline, power-series or sigmoid.")


def _why(solution: Solution, delta_bic: float) -> list[str]:
    linear = solution.linear
    noise = "AR(1)" if delta_bic > 0 else "white"
    enough = "a white residual" if delta_bic <= 0 else "but the residual isn't white: try order=auto, or diagnose"
    return [
        f"second order: T {linear.time_constant_s:.4g} s, damping {linear.damping:.3g}, "
        f"delay {1e3 * linear.delay_s:.1f} ms; {enough}",
        f"noise taken as {noise}: BIC of AR(1) is {abs(delta_bic):.1f} {'better' if delta_bic > 0 else 'worse'}",
    ]


def estimate(
    grid: Grid, rows: np.ndarray, knots: int | None = None, delay_s: float | None = None
) -> tuple[Solution, float]:
    """The solution, and the evidence for AR(1) over white noise (ΔBIC)."""
    first = pilot_solution(grid, rows, begins_at_rest(grid), delay_s)
    problem, start = designed(first, knots)
    solution = search(problem, start)
    ar1, delta_bic = noise_evidence(solution.residual_nm, problem.stretches)
    if delta_bic > 0 and knots is None and problem.basis.size < KNOTS:
        # Structure may be a bend that few knots can't follow: look again with all before calling it noise.
        problem, start = designed(first, KNOTS)
        solution = search(problem, start)
        ar1, delta_bic = noise_evidence(solution.residual_nm, problem.stretches)
    # What is left of a record without noise is rounding and the spline's own error: not worth a noise model.
    still = solution.variance < (ROUNDING * float(np.ptp(problem.target[rows]))) ** 2
    for _ in range(0 if still else 3):
        if delta_bic <= 0:
            break
        solution = search(problem, solution.linear, ar1=ar1)
        before = ar1
        ar1, delta_bic = noise_evidence(solution.residual_nm, problem.stretches)
        if abs(ar1 - before) < 0.01:
            break
    return solution, delta_bic

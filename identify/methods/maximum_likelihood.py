"""Maximum likelihood: one joint estimate of recruitment and dynamics on all segments, with white or correlated noise.

It differs from the paper: the cost (12), the output error, is minimised over recruitment and dynamics together, instead
of one after the other; the noise may be correlated; the smoothness of the spline is chosen from the data.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from stimrig.identify.dynamics.pulse_grid import Grid
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.estimation.pilot import estimate
from stimrig.identify.estimation.prepare import to_fitted
from stimrig.identify.estimation.rows import fitted_rows, still_rows
from stimrig.identify.methods.support.alternatives import monotone, near_sigmoid, power_series, sigmoid
from stimrig.identify.methods.support.common import flag, order_option
from stimrig.identify.methods.two_stage import general
from stimrig.identify.model import Model
from stimrig.identify.recruitment.knots import KNOTS


class MaximumLikelihood:
    """The default method."""

    id = "maximum-likelihood"
    summary = "Joint estimate of recruitment spline and second-order dynamics by variable projection on all segments."
    options: Mapping[str, str] = MappingProxyType(
        {
            "recruitment": "spline (default, (8)), power-series (6), sigmoid (30) or near-sigmoid, for short records",
            "earlier": "with near-sigmoid: this person's last model, from which the curve is not expected to be far",
            "monotone": "true: the spline never falls (default: false)",
            "knots": "number of knots of the spline (default: 19, or 31 if the curve is steep)",
            "power": "order of the power series (default: by BIC)",
            "delay_s": "a known delay, s (default: estimated)",
            "order": "second-order (default), auto, or l,n,d of equations (1) to (3)",
        }
    )

    def fit(self, grid: Grid, fit_on: tuple[str, ...] | None, **options: Any) -> Model:
        """Fit; see `identify.fit`."""
        rows = fitted_rows(grid, fit_on)
        order = order_option(options.get("order", "second-order"))
        if order != "second-order":
            return general(self.id, grid, rows, rows, 8, int(options.get("knots", KNOTS)), order)
        fitted, reasons = self.start(grid, rows, options)
        return finish(self.id, fitted, [*reasons, *_why(fitted)])

    def start(self, grid: Grid, rows: np.ndarray, options: Mapping[str, Any]) -> tuple[Fitted, list[str]]:
        """Fit the structure without effects, to which effects are added; with the reasons for its form."""
        if options.get("recruitment") == "near-sigmoid" or "earlier" in options:
            return near_sigmoid(grid, rows, options)
        delay_s = float(options["delay_s"]) if "delay_s" in options else None
        knots = int(options["knots"]) if "knots" in options else None
        solution, _ = estimate(grid, still_rows(grid, rows), knots, delay_s)
        kind = str(options.get("recruitment", "spline"))
        if kind == "power-series":
            solution, reason = power_series(solution, int(options["power"]) if "power" in options else None)
        elif kind == "sigmoid":
            solution, reason = sigmoid(solution), "sigmoid (30)"
        elif kind == "spline":
            size = solution.projection.basis.size
            reason = f"spline of {size} coefficients, smoothed to {solution.freedom:.1f} effective ones"
        else:
            raise BadRequest(
                f"unknown recruitment {kind!r}",
                place="recruitment",
                fix="Give spline, power-series, sigmoid or near-sigmoid.",
            )
        if flag(options.get("monotone", False), "monotone"):
            return to_fitted(monotone(solution), rows, most=0), [reason, "recruitment constrained to be monotone"]
        return to_fitted(solution, rows, most=20 if kind == "spline" else 0), [reason]


METHOD = MaximumLikelihood()


def _why(fitted: Fitted) -> list[str]:
    time_constant_s, damping, delay_s = fitted.physical[:3]
    noise = fitted.noise
    said = "white" if noise.is_white else f"slow and white; {100 * min(noise.share, 1.0):.0f} % of the variance is slow"
    enough = "a white residual" if noise.is_white else "the residual is not white: see the diagnosis"
    return [
        f"second order: T {time_constant_s:.4g} s, damping {damping:.3g}, delay {1e3 * delay_s:.1f} ms; {enough}",
        f"noise: {said}",
    ]

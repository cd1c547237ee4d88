"""The paper's two-stage method (section III): PRBS for the dynamics, ramp for the recruitment, dynamics once more.

With the two levels of the PRBS, w is proportional to u (15), which gives a first linear part. With it, the spline is
found on the ramp (stage one). With the spline, the linear part is found again (stage two). One iteration is made.
There are three differences from the paper, whose text fails with output noise (docs/results/table1.md):

- the linear part minimises the output error (12), not the equation error (25), which makes the poles 4 times too slow;
- the spline is fitted to the output of G; the inverse of G (26) is unstable because of a zero near -1;
- the spline has many knots and a penalty chosen from the data, not few knots without a penalty.

`linear="equation-error"` and `inverse=True` follow the text of the paper, for comparison.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.errors import BadRequest, NotIdentifiable
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.plain import curve_at, final_spline, fit_from, plain_setup, start_at
from stimrig.identify.estimation.solve import Fitted, solve
from stimrig.identify.methods import Method
from stimrig.identify.methods.common import flag, near_rest, order_option, segment_rows
from stimrig.identify.methods.transfer_function import general
from stimrig.identify.model import Model
from stimrig.identify.noise import WHITE_AND_SLOW
from stimrig.identify.recruitment import Curve, FixedShape
from stimrig.identify.recruitment.bases import PowerBasis, SplineBasis
from stimrig.identify.recruitment.smoothing import KNOTS, PILOT_KNOTS, spline_roughness

STARTS_S = (0.06, 0.15, 0.35, 0.8)
LEVEL = 0.02
"""Pulse widths closer than this share of the largest are one level."""
TWO_LEVELS = 0.5
"""Share of the intervals at the two most frequent levels: 1 in a PRBS, 0.75 in the two PRBS of `short`."""


def fit(grid: Grid, fit_on: tuple[str, ...] | None, **options: Any) -> Model:
    """Fit; the first name of `fit_on` is the segment for the dynamics, the others for the recruitment."""
    names = fit_on or ("prbs", "ramp")
    if len(names) < 2:
        message = "two-stage needs two segments, the first for the dynamics, the second for the recruitment"
        raise BadRequest(message, place="fit_on", fix="Give, for example, prbs,ramp.")
    prbs = segment_rows(grid, names[:1], METHOD.id)
    refuse_levels(grid.pulse_width_us[prbs], names[0])
    ramp = segment_rows(grid, names[1:], METHOD.id)
    iterations = int(options.get("iterations", 1))
    knots = int(options.get("knots", KNOTS))
    literal = options.get("linear", "output-error") == "equation-error"
    inverse = flag(options.get("inverse", False), "inverse")
    order = order_option(options.get("order", "second-order"))
    if order == "second-order" and not literal and not inverse:
        fitted, reasons = physical(grid, prbs, ramp, iterations, knots)
        return finish(METHOD.id, fitted, reasons)
    return general(METHOD.id, grid, prbs, ramp, iterations, knots, order, literal, inverse)


METHOD = Method(
    "two-stage",
    "The paper's method: dynamics from the PRBS, recruitment spline from the ramp, dynamics again.",
    {
        "iterations": "number of iterations of stage one and stage two (default: 1)",
        "order": "second-order (default), auto, or l,n,d of equations (1) to (3)",
        "linear": "output-error (default) or equation-error, equation (25) as printed",
        "inverse": "true: recruitment by inverting G, equation (26) as printed (default: false)",
        "knots": "number of knots of the spline (default: 31)",
    },
    fit,
)


def refuse_levels(width_us: np.ndarray, name: str) -> None:
    """Refuse a segment for the dynamics that two levels do not fill for the most part.

    A few other widths do no harm, because the dynamics are estimated once more with the curve. Raises NotIdentifiable.
    """
    _, counts = np.unique(np.round(width_us / (LEVEL * max(float(np.max(width_us)), 1e-300))), return_counts=True)
    if np.sort(counts)[-2:].sum() < TWO_LEVELS * width_us.size:
        message = f"two-stage needs two levels of pulse width in {name}; it has {counts.size}"
        fix = "Name a PRBS first in fit_on, or use maximum-likelihood, which takes any."
        raise NotIdentifiable(message, fix=fix)


def physical(
    grid: Grid, prbs: np.ndarray, ramp: np.ndarray, iterations: int = 1, knots: int = KNOTS
) -> tuple[Fitted, list[str]]:
    """Two stages with the linear part in physical terms.

    `prbs` and `ramp`, bool, shape (K,), are the rows for the dynamics and for the recruitment; of `iterations` and
    `knots` see `METHOD.options`.
    """
    rows, none = near_rest(grid, ramp), np.zeros((1, 1))
    # Two levels only, so f can be taken as a straight line through both (15).
    straight = plain_setup(grid, near_rest(grid, prbs), PowerBasis(1, float(np.max(grid.pulse_width_us))))
    linear = fit_from(straight, STARTS_S, none).linear
    reasons = [f"PRBS alone: T {linear.time_constant_s:.4g} s, damping {linear.damping:.3g}"]
    both = plain_setup(grid, near_rest(grid, prbs) | rows, straight.basis)
    curve, roughness = _recruitment(grid, rows, linear, knots)
    for _ in range(iterations):
        problem, theta, white = start_at(both.without_penalty(FixedShape(curve)), linear, none)
        linear = solve(problem, theta, white).linear
        curve, roughness = _recruitment(grid, rows, linear, knots)
    reasons.append(f"after stage two: T {linear.time_constant_s:.4g} s, damping {linear.damping:.3g}")
    # The last curve and the last dynamics; baseline and noise are estimated from both segments.
    problem, theta, _ = start_at(both.without_penalty(curve.basis), linear, roughness)
    return solve(problem, theta, WHITE_AND_SLOW, max_steps=0), reasons


def _recruitment(grid: Grid, rows: np.ndarray, linear: SecondOrder, knots: int) -> tuple[Curve, np.ndarray]:
    """Stage one: the spline for given dynamics, fitted to the output of G, and the penalty on its bending."""
    basis = SplineBasis(np.linspace(0.0, float(np.max(grid.pulse_width_us)), PILOT_KNOTS))
    setup = plain_setup(grid, rows, basis)
    coarse = curve_at(setup, linear, spline_roughness(basis))
    basis, roughness = final_spline(setup, linear, coarse, knots)
    return curve_at(setup.without_penalty(basis), linear, roughness), roughness

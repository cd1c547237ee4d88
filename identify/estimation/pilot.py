"""The plain structure fitted to a record: a pilot with few knots, the final spline, the choice of the noise."""

from __future__ import annotations

import numpy as np

from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.dynamics.pulse_grid import Grid
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.projected_search import State, bounded, descend, search
from stimrig.identify.estimation.projection import Projection, Solution
from stimrig.identify.noise.ar1 import ar1_or_white, whiten
from stimrig.identify.recruitment.knots import (
    KNOTS,
    PILOT_KNOTS,
    QUIET_KNOTS,
    adapted_knots,
    bending_order,
    knots_for,
    spline_roughness,
)
from stimrig.identify.recruitment.spline import SplineBasis

STARTS_S = (0.12, 0.4)
ROUNDING = 2e-5
"""Share of the torque's range below which a residual is not noise."""
QUIET = 0.0015
"""If the noise of a sample is below this share of the torque's range, the spline gets more knots: its error at a bend
would be visible."""
CURVE_POINTS = 201


def pilot_solution(grid: Grid, rows: np.ndarray, delay_s: float | None = None) -> Solution:
    """A first fit with few knots, from the best of several starting values of the time constant.

    Raises
    ------
    NotIdentifiable
        The pulse width or the torque never changes.
    """
    largest = float(np.max(grid.pulse_width_us))
    seen = grid.pulse_width_us[rows]
    if not largest > 0 or np.ptp(seen) <= 0:
        raise NotIdentifiable(
            "the pulse width never changes in the fitted rows" if largest > 0 else "the record has no pulse",
            fix="Record a PRBS and a ramp.",
        )
    if np.ptp(grid.torque_nm[rows]) <= 0:
        raise NotIdentifiable("the torque never changes", fix="Check the load cell and the electrodes.")
    basis = SplineBasis(np.linspace(0.0, largest, PILOT_KNOTS))
    order = bending_order(grid.pulse_width_us[rows])
    projection = Projection(grid, basis, spline_roughness(basis, order=order), rows, delay_s)
    target = whiten(projection.target, projection.stretches, 0.0)
    delay = 0.0 if delay_s is None else delay_s
    starts = [State(projection, bounded(projection, SecondOrder(t, 0.9, delay)), target, 0.0, None) for t in STARTS_S]
    best = min(starts, key=lambda state: state.cost)
    return descend(best, most=12, tolerance=0.5)


def designed(first: Solution, count: int | None = None) -> tuple[Projection, SecondOrder]:
    """The projection with its final spline, and the start of its search, from a pilot.

    The few knots of the pilot show roughly where the curve bends. A curve with all knots shows place and size of the
    bend better; repeating this once improves a steep rise.
    """
    old = first.projection
    curve = pilot_curve(first)
    count = knots_for(curve) if count is None else count
    basis = SplineBasis(adapted_knots(curve, float(np.max(old.grid.pulse_width_us)), count))
    order = bending_order(old.grid.pulse_width_us[old.rows])
    projection = Projection(old.grid, basis, spline_roughness(basis, order=order), old.rows, old.delay_s)
    target = whiten(projection.target, projection.stretches, 0.0)
    for _ in range(2):
        coefficients = State(projection, first.linear, target, 0.0, None).coefficients[: basis.size]
        projection, basis = _redesigned(projection, basis, coefficients, count)
    return projection, first.linear


def _redesigned(
    old: Projection, basis: SplineBasis, coefficients: np.ndarray, count: int
) -> tuple[Projection, SplineBasis]:
    """The projection with knots and penalty from a first curve."""
    u = np.linspace(0.0, basis.largest_us, CURVE_POINTS)
    new = SplineBasis(adapted_knots((u, basis.design(u) @ coefficients), basis.largest_us, count))
    order = bending_order(old.grid.pulse_width_us[old.rows])
    roughness = spline_roughness(new, (basis, coefficients), order)
    return Projection(old.grid, new, roughness, old.rows, old.delay_s), new


def pilot_curve(solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """The curve of a solution on 201 pulse widths."""
    basis = solution.projection.basis
    u = np.linspace(0.0, basis.largest_us, CURVE_POINTS)
    return u, basis.design(u) @ solution.coefficients[: basis.size]


def estimate(
    grid: Grid, rows: np.ndarray, knots: int | None = None, delay_s: float | None = None
) -> tuple[Solution, float]:
    """The solution, and the evidence for AR(1) over white noise (ΔBIC)."""
    first = pilot_solution(grid, rows, delay_s)
    quiet = 0.0 < grid.noise_sd_nm < QUIET * float(np.ptp(grid.torque_nm[rows]))
    projection, start = designed(first, QUIET_KNOTS if knots is None and quiet else knots)
    solution = search(projection, start)
    ar1, delta_bic = ar1_or_white(solution.residual_nm, projection.stretches)
    if delta_bic > 0 and knots is None and projection.basis.size < KNOTS:
        # The correlation may come from a bend that few knots cannot follow: first try all knots.
        projection, start = designed(first, KNOTS)
        solution = search(projection, start)
        ar1, delta_bic = ar1_or_white(solution.residual_nm, projection.stretches)
    # Without noise the residual is rounding and the spline's own error, which need no noise model.
    still = solution.variance < (ROUNDING * float(np.ptp(projection.target[rows]))) ** 2
    for _ in range(0 if still else 3):
        if delta_bic <= 0:
            break
        solution = search(projection, solution.linear, ar1=ar1)
        before = ar1
        ar1, delta_bic = ar1_or_white(solution.residual_nm, projection.stretches)
        if abs(ar1 - before) < 0.01:
            break
    return solution, delta_bic

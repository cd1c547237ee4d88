"""The recruitment spline for a given discrete linear block: fitted to its output, or by inverting it."""

from __future__ import annotations

import numpy as np

from identify.dynamics.linear import Discrete
from identify.dynamics.pulse_grid import Grid
from identify.dynamics.second_order import recursion
from identify.recruitment.curve import Curve
from identify.recruitment.knots import PILOT_KNOTS, adapted_knots, even_knots, spline_roughness
from identify.recruitment.smoothing import choose_weight
from identify.recruitment.spline import SplineBasis


def from_output(grid: Grid, block: Discrete, rows: np.ndarray, knots: int, baseline_nm: float) -> Curve:
    """Least squares on the output: the columns of the spline are filtered, the torque is not."""
    target = grid.torque_nm[rows] - baseline_nm
    return _penalised(grid, lambda columns: block.filter(grid.held(columns))[rows], target, knots)


def from_inverse(grid: Grid, block: Discrete, rows: np.ndarray, knots: int, baseline_nm: float) -> Curve:
    """Equations (26) to (28) as printed: w = G⁻¹ y, then the spline by least squares on w.

    The inverse diverges if G has a zero on or outside the unit circle; it is then limited to ±1e6 N·m.
    """
    torque = np.nan_to_num(grid.torque_nm) - baseline_nm
    b = np.asarray(block.b) / block.b[0]
    moved = np.r_[torque[block.delay_samples :], np.zeros(block.delay_samples)]
    driven = np.convolve(moved, block.a)[: moved.size] / block.b[0]
    start = int(np.flatnonzero(rows)[0])
    driven[:start] = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        w = np.clip(np.nan_to_num(recursion(b, driven)), -1e6, 1e6)
    return _penalised(grid, lambda columns: grid.held(columns)[rows], w[rows], knots)


def _penalised(grid: Grid, respond, target: np.ndarray, knots: int) -> Curve:
    largest = float(np.max(grid.pulse_width_us))
    basis = SplineBasis(even_knots(largest, PILOT_KNOTS))
    roughness = spline_roughness(basis)
    curve = Curve(basis, np.zeros(basis.size))
    for last in (False, True):
        design = respond(basis.design(grid.pulse_width_us))
        gram, moment = design.T @ design, design.T @ target
        weight = choose_weight(gram, moment, float(target @ target), target.size, roughness).weight
        ridge = 1e-12 * float(np.trace(gram)) / len(gram) * np.eye(len(gram))
        curve = Curve(basis, np.linalg.solve(gram + weight * roughness + ridge, moment))
        if not last:
            u = np.linspace(0.0, largest, 201)
            first, basis = basis, SplineBasis(adapted_knots((u, curve(u)), largest, knots))
            roughness = spline_roughness(basis, (first, curve.coefficients_nm))
    return curve

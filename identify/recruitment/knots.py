"""Where the knots of the recruitment spline stand: one common set for a record, whatever is fitted on it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from identify.recruitment.spline import SplineBasis

if TYPE_CHECKING:
    from identify.grid import Grid

KNOTS = 31
PILOT_KNOTS = 12
NARROWEST_US = 0.5


def even_knots(largest_us: float, count: int) -> np.ndarray:
    """Evenly spaced knots from 0 to the largest pulse width, µs."""
    return np.linspace(0.0, largest_us, count)


def design_knots(grid: Grid, count: int = KNOTS) -> np.ndarray:
    """Knots for a record, µs, shape (m,), first 0, last the largest pulse width of all rows.

    Half of the knots are spread evenly, half go where a pilot fit says that the curve bends, so that a rise within
    5 µs is met as well as one over 200 µs. The same knots serve every candidate: what one model may bend, all may.
    """
    from identify.projection import pilot

    return adapted_knots(pilot(grid), float(np.max(grid.pulse_width_us)), count)


def adapted_knots(pilot_curve: tuple[np.ndarray, np.ndarray], largest_us: float, count: int = KNOTS) -> np.ndarray:
    """Knots from a pilot curve (pulse widths, torques): half by length, half by how it bends."""
    u, torque = pilot_curve
    bend = np.abs(np.gradient(np.gradient(torque, u), u)) ** (1 / 4)
    # Smoothed, since a pilot knows only roughly where the bend is.
    width = max(u.size // 40, 1)
    bend = np.convolve(np.pad(bend, width, mode="edge"), np.ones(2 * width + 1) / (2 * width + 1), mode="valid")
    density = 0.5 + 0.5 * bend / max(float(np.mean(bend)), 1e-300)
    mass = np.r_[0.0, np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(u))]
    count = int(min(count, max(largest_us / NARROWEST_US, 4)))
    knots = np.interp(np.linspace(0.0, mass[-1], count), mass, u)
    knots[0], knots[-1] = 0.0, largest_us
    return knots


def spline_roughness(basis: SplineBasis) -> np.ndarray:
    """∫ω f'' ² with ω lower where knots are denser, scaled to be free of units: the one penalty for every candidate."""
    node, weight = np.polynomial.legendre.leggauss(3)
    gaps = np.diff(basis.knots_us)
    half = gaps / 2
    u = (basis.knots_us[:-1] + half)[:, None] + half[:, None] * node
    second = basis.design(u.ravel(), derivative=2)
    local = (gaps / gaps.mean()) ** 3
    weights = (local * half)[:, None] * weight
    span = basis.knots_us[-1]
    return second.T @ (second * weights.ravel()[:, None]) * span**3

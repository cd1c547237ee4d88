"""Where the knots of the recruitment spline stand, and how much each part may bend: one design for a record."""

from __future__ import annotations

import numpy as np

from identify.recruitment.spline import SplineBasis

KNOTS = 31
SMOOTH_KNOTS = 19
"""Enough where a pilot's curve takes more than a quarter of the range to rise: less to compute, nothing lost."""
QUIET_KNOTS = 61
"""Where the noise is so small that what fewer knots leave at a bend would look like an effort or a tremor."""
PILOT_KNOTS = 9
NARROWEST_US = 0.5
STRAIGHTEST = 0.003
"""Least share of the strongest bending that the penalty expects anywhere, so that no part is forced straight."""


def even_knots(largest_us: float, count: int) -> np.ndarray:
    """Evenly spaced knots from 0 to the largest pulse width, µs."""
    return np.linspace(0.0, largest_us, count)


def knots_for(pilot_curve: tuple[np.ndarray, np.ndarray]) -> int:
    """How many knots a curve needs that a pilot of few knots has drawn (10 to 90 % of its rise)."""
    u, torque = pilot_curve
    level = np.abs(torque) / max(float(np.max(np.abs(torque))), 1e-300)
    rise = u[np.argmax(level >= 0.9)] - u[np.argmax(level >= 0.1)]
    return SMOOTH_KNOTS if rise > u[-1] / 4 else KNOTS


def adapted_knots(pilot_curve: tuple[np.ndarray, np.ndarray], largest_us: float, count: int = KNOTS) -> np.ndarray:
    """Knots from a pilot curve (pulse widths, torques): half by length, half by how it bends."""
    u, torque = pilot_curve
    bend = np.abs(np.gradient(np.gradient(torque, u), u)) ** 0.5
    # Smoothed, since a pilot knows only roughly where the bend is.
    width = max(u.size // 40, 1)
    bend = np.convolve(np.pad(bend, width, mode="edge"), np.ones(2 * width + 1) / (2 * width + 1), mode="valid")
    density = 0.5 + 0.5 * bend / max(float(np.mean(bend)), 1e-300)
    mass = np.r_[0.0, np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(u))]
    count = int(min(count, max(largest_us / NARROWEST_US, 4)))
    knots = np.interp(np.linspace(0.0, mass[-1], count), mass, u)
    knots[0], knots[-1] = 0.0, largest_us
    return knots


FEW_LEVELS = 6


def bending_order(widths_us: np.ndarray) -> int:
    """Which derivative to keep small: the third, or the second where so few widths were applied that a parabola would
    be free to do anything between them.
    """
    return 3 if np.unique(widths_us).size > FEW_LEVELS else 2


def spline_roughness(
    basis: SplineBasis, pilot: tuple[SplineBasis, np.ndarray] | None = None, order: int = 3
) -> np.ndarray:
    """∫ω f'''² over the knots (or ∫ω f''²), scaled to be free of units.

    The third derivative, since a recruitment curve is a smooth bend and not a straight line; ω lets it bend where it
    does bend: from a pilot's own third derivative where there is one, else from the spacing of the knots. A rise
    within a few µs then doesn't cost the smoothness of the plateau.

    Parameters
    ----------
    basis : SplineBasis
        The spline that is penalised.
    pilot : tuple of SplineBasis and ndarray, optional
        A first estimate: basis and coefficients.
    order : int
        Derivative that is kept small, 3 or 2 (see `bending_order`).
    """
    if order == 2:
        return basis.roughness * basis.largest_us**3
    gaps = np.diff(basis.knots_us)
    middle = basis.knots_us[:-1] + gaps / 2
    third = basis.design(middle, derivative=3)
    if pilot is None:
        ease = (gaps / gaps.mean()) ** 3
    else:
        own = pilot[0].knots_us
        centre = (own[1:] + own[:-1]) / 2
        energy = (pilot[0].design(centre, derivative=3) @ pilot[1]) ** 2
        energy = np.convolve(np.pad(energy, 2, mode="edge"), [0.1, 0.2, 0.4, 0.2, 0.1], mode="valid")
        ease = 1.0 / (np.interp(middle, centre, energy) / max(float(energy.max()), 1e-300) + STRAIGHTEST)
    return third.T @ (third * (ease * gaps)[:, None]) * basis.largest_us**5

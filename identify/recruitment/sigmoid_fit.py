"""Least-squares fit of the sigmoid (30)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stimrig.identify.recruitment.curve import Curve
from stimrig.identify.recruitment.sigmoid import SigmoidBasis


def basis_at(steepness_log: float, middle_us: float, largest_us: float) -> SigmoidBasis:
    """The sigmoid with a given log steepness and middle, µs: parameters that suit a numerical search."""
    a2 = float(np.exp(steepness_log))
    return SigmoidBasis(a2, float(max(np.exp(min(a2 * middle_us, 600.0)) - 2.0, -0.999)), largest_us)


def fit_shape(
    residual_of: Callable[[SigmoidBasis], np.ndarray], largest_us: float, seen_us: np.ndarray
) -> SigmoidBasis:
    """Least-squares estimate of the two shape parameters: a coarse scan, then a bounded trust-region search.

    Parameters
    ----------
    residual_of : callable
        Gives the residual for a shape, with all linear parameters solved for.
    largest_us : float
        Largest pulse width.
    seen_us : ndarray
        Pulse widths that were applied, µs; they bound the middle.
    """
    from scipy.optimize import least_squares

    top = max(float(np.max(seen_us)), 1e-6)
    scan = [
        (float(np.log(steep / top)), share * top)
        for steep in (3.0, 6.0, 12.0, 25.0, 60.0)
        for share in (0.15, 0.3, 0.45, 0.6, 0.8)
    ]

    def residual(x: np.ndarray) -> np.ndarray:
        return residual_of(basis_at(x[0], x[1] * top, largest_us))

    costs = [float(np.sum(residual(np.array([s, m / top])) ** 2)) for s, m in scan]
    best = scan[int(np.argmin(costs))]
    bounds = ([np.log(0.5 / top), 0.0], [np.log(2000.0 / top), 1.2])
    found = least_squares(
        residual, [best[0], best[1] / top], bounds=bounds, x_scale=[0.3, 0.05], xtol=1e-12, ftol=1e-14, gtol=1e-14
    )
    return basis_at(found.x[0], found.x[1] * top, largest_us)


def fit_points(width_us: np.ndarray, torque_nm: np.ndarray) -> Curve:
    """The sigmoid fitted to points, with its gain."""
    largest = float(np.max(width_us))

    def gain_and_residual(basis: SigmoidBasis) -> tuple[float, np.ndarray]:
        column = basis.design(width_us)[:, 0]
        gain = float(column @ torque_nm / max(float(column @ column), 1e-300))
        return gain, torque_nm - gain * column

    basis = fit_shape(lambda b: gain_and_residual(b)[1], largest, width_us)
    return Curve(basis, np.array([gain_and_residual(basis)[0]]))

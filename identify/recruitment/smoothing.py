"""Knots of the recruitment spline, the penalty on its bending, and the penalty's weight from the data (REML)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.identify.recruitment.bases import SplineBasis

KNOTS = 31
SMOOTH_KNOTS = 19
"""Enough if the pilot's curve rises over more than a quarter of the range: less to compute, and nothing is lost."""
QUIET_KNOTS = 61
"""For very small noise: the error of fewer knots at a bend would look like an effort or a tremor."""
PILOT_KNOTS = 9
NARROWEST_US = 0.5
STRAIGHTEST = 0.003
"""The penalty expects at least this share of the strongest bending everywhere, so no part is forced to be straight."""


def knots_for(pilot_curve: tuple[np.ndarray, np.ndarray]) -> int:
    """Number of knots that a curve needs, from the width of its rise (10 to 90 %) in a pilot fit."""
    u, torque = pilot_curve
    level = np.abs(torque) / max(float(np.max(np.abs(torque))), 1e-300)
    rise = u[np.argmax(level >= 0.9)] - u[np.argmax(level >= 0.1)]
    return SMOOTH_KNOTS if rise > u[-1] / 4 else KNOTS


def adapted_knots(pilot_curve: tuple[np.ndarray, np.ndarray], largest_us: float, count: int = KNOTS) -> np.ndarray:
    """Knots from a pilot curve (pulse widths, torques): their density follows half the length, half the bending."""
    u, torque = pilot_curve
    bend = np.abs(np.gradient(np.gradient(torque, u), u)) ** 0.5
    # Smoothed, since the pilot shows the place of the bend only roughly.
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
    """Derivative that the penalty keeps small: the third, or with few different widths the second.

    With few widths a penalty on the third derivative would leave a parabola between them undetermined.
    """
    return 3 if np.unique(widths_us).size > FEW_LEVELS else 2


def spline_roughness(
    basis: SplineBasis, pilot: tuple[SplineBasis, np.ndarray] | None = None, order: int = 3
) -> np.ndarray:
    """Penalty ∫ω f'''² over the knots (or ∫ω f''²), scaled to have no unit.

    The third derivative is used because a recruitment curve is a smooth bend, not a straight line. ω allows bending
    where the curve bends: it follows the third derivative of a pilot, or else the spacing of the knots. So a rise
    within a few µs does not make the plateau rough.

    `basis`: the spline that is penalised; `pilot`: basis and coefficients of a first estimate; `order`: derivative that
    the penalty keeps small, 3 or 2 (see `bending_order`).
    """
    if order == 2:
        return basis.roughness * basis.largest_us**3
    gaps = np.diff(basis.knots_us)
    middle = basis.knots_us[:-1] + gaps / 2
    third = basis.design(middle, derivative=3)
    if pilot is None:
        ease = (gaps / gaps.mean()) ** 3
    else:
        pilot_knots_us = pilot[0].knots_us
        centre = (pilot_knots_us[1:] + pilot_knots_us[:-1]) / 2
        energy = (pilot[0].design(centre, derivative=3) @ pilot[1]) ** 2
        energy = np.convolve(np.pad(energy, 2, mode="edge"), [0.1, 0.2, 0.4, 0.2, 0.1], mode="valid")
        ease = 1.0 / (np.interp(middle, centre, energy) / max(float(energy.max()), 1e-300) + STRAIGHTEST)
    return third.T @ (third * (ease * gaps)[:, None]) * basis.largest_us**5


def fitting_spline(
    curve: tuple[np.ndarray, np.ndarray],
    largest_us: float,
    count: int,
    widths_us: np.ndarray,
    pilot: tuple[SplineBasis, np.ndarray] | None = None,
) -> tuple[SplineBasis, np.ndarray]:
    """A spline with so many knots, where a curve bends, and the penalty on it that the fitted widths ask for."""
    basis = SplineBasis(adapted_knots(curve, largest_us, count))
    return basis, spline_roughness(basis, pilot, bending_order(widths_us))


LOWEST, HIGHEST = 1e-9, 1e9
"""Bounds of the weight, relative to the balance of data and penalty."""

TILT = 1e-3
"""Penalty on an e-fold weight, in twice the log likelihood: where the data do not decide, the smaller weight wins."""


@dataclass(frozen=True)
class Choice:
    """A penalty's weight."""

    weight: float  # factor of the roughness in the sum of squares, N²m² per unit of roughness
    variance: float  # noise variance at that weight, N²m²


def choose_weight(
    gram: np.ndarray, moment: np.ndarray, energy: float, rows: int, roughness: np.ndarray, free: int = 0
) -> Choice:
    """The weight of the penalty in min ||y - Z c||² + weight c'Rc that makes the data most likely (REML).

    The penalty is taken as a prior, the coefficients are integrated out, and the noise variance is profiled (Wahba
    1985; Wood 2011). One eigendecomposition serves all weights.

    `gram`, `moment`, `energy`: Z'Z, Z'y and y'y of `rows` whitened rows; `free` columns without a penalty are already
    projected out. `roughness`: R.
    """
    size = len(gram)
    scale = np.sqrt(np.maximum(np.diag(roughness), 1e-300))  # of close knots much larger than of others
    # Shapes that are not penalised; from the penalty, as the data do not cover all shapes.
    straight = int(np.sum(np.linalg.eigvalsh(roughness / scale / scale[:, None]) <= 1e-13))
    freedom_left = max(rows - free - straight, 1)
    balance = np.trace(gram) / max(np.trace(roughness), 1e-300)
    floor = 1e-11 * balance
    root = np.linalg.cholesky(gram + floor * roughness + 1e-13 * np.trace(gram) / size * np.eye(size))
    inverse = np.linalg.inv(root)
    half = inverse @ roughness @ inverse.T
    bent, turn = np.linalg.eigh((half + half.T) / 2)
    bent = np.maximum(bent, 0.0)  # of knots a wide range apart rounding leaves negative ones
    bent[:straight] = 0.0  # else rounding would decide among the weights of a curve that is not bent at all
    part = (turn.T @ (inverse @ moment)) ** 2
    smallest = 1e-14 * energy

    def bottom(weight: np.ndarray) -> np.ndarray:
        return 1.0 + (weight - floor)[:, None] * bent

    weight = balance * np.exp(np.linspace(np.log(LOWEST), np.log(HIGHEST), 73))
    squares = np.maximum(energy - (part / bottom(weight)).sum(axis=1), smallest + 1e-300)
    score = -freedom_left * np.log(squares) - np.log(bottom(weight)).sum(axis=1)
    score += (size - straight - TILT) * np.log(weight)
    best = int(np.argmax(score))
    chosen = float(weight[best])
    if 0 < best < weight.size - 1:  # the top of the parabola through three points
        below, here, above = score[best - 1 : best + 2]
        shift = 0.5 * (below - above) / min(below - 2 * here + above, -1e-12)
        chosen = float(chosen * (weight[1] / weight[0]) ** shift)
    left = max(energy - float((part / bottom(np.array([chosen]))).sum()), smallest)
    return Choice(chosen, left / freedom_left)

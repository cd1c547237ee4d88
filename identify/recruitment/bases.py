"""Bases of recruitment curves: cubic splines (8), power series (6) and the sigmoid (30) of the paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

DEGREE = 3


@dataclass(frozen=True)
class SplineBasis:
    """Cubic splines on given knots that vanish at zero pulse width.

    They are the same functions as in equation (8) of the paper. The cubes |u - u_i|³ used there are nearly collinear,
    and their normal equations lose half of the digits; B-splines lose none. f(0) = 0 holds because the one B-spline
    that is not zero there is left out.
    """

    knots_us: np.ndarray  # shape (m,); strictly increasing, µs, first 0, last the largest pulse width

    @property
    def size(self) -> int:
        """Number of coefficients, m + 1."""
        return self.knots_us.size + DEGREE - 2

    @cached_property
    def _padded(self) -> np.ndarray:
        return np.r_[[self.knots_us[0]] * DEGREE, self.knots_us, [self.knots_us[-1]] * DEGREE]

    def design(self, pulse_width_us: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Basis functions (or a derivative) at pulse widths of any shape; shape (..., size).

        Beyond the knots the function is constant (its derivatives are zero).
        """
        u = np.asarray(pulse_width_us, float)
        inside = np.clip(u, self.knots_us[0], self.knots_us[-1])
        values = bsplines(self._padded, DEGREE, inside.ravel(), derivative).reshape(*u.shape, -1)
        if derivative:
            values = np.where((inside == u)[..., None], values, 0.0)
        return values[..., 1:]

    @cached_property
    def roughness(self) -> np.ndarray:
        """∫ f''² over the knots, as a quadratic form, shape (size, size), µs⁻³."""
        node, weight = np.polynomial.legendre.leggauss(3)
        half = np.diff(self.knots_us) / 2
        u = (self.knots_us[:-1] + half)[:, None] + half[:, None] * node
        second = self.design(u.ravel(), derivative=2)
        return second.T @ (second * (half[:, None] * weight).ravel()[:, None])

    @property
    def largest_us(self) -> float:
        """Pulse width beyond which the curve is held, µs."""
        return float(self.knots_us[-1])

    def to_dict(self) -> dict:
        return {"kind": "cubic-spline", "knots_us": [float(u) for u in self.knots_us]}


def bsplines(padded: np.ndarray, degree: int, at: np.ndarray, derivative: int = 0) -> np.ndarray:
    """B-splines, or their derivative, by the recursion of Cox and de Boor (de Boor 1978, ch. X); shape (N, size).

    Not from scipy.interpolate, whose import would add 0.2 s to every start of the command.

    `padded`: knots, with the outer ones repeated `degree` times. `at`: places within the knots, shape (N,).
    `derivative`: 0 to `degree`.
    """
    if derivative:
        lower = bsplines(padded[1:-1], degree - 1, at, derivative - 1)
        gap = degree / (padded[degree + 1 : -1] - padded[1 : -degree - 1])
        edge = np.zeros((at.size, 1))
        scaled = np.concatenate([edge, lower * gap, edge], axis=1)
        return scaled[:, :-1] - scaled[:, 1:]
    size = padded.size - degree - 1
    span = np.clip(np.searchsorted(padded, at, side="right") - 1, degree, size - 1)
    near = padded[span + np.arange(1 - degree, degree + 1)[:, None]]
    above, below = near[degree:] - at, at - near[:degree]
    local = np.zeros((degree + 1, at.size))
    local[0] = 1.0
    for order in range(1, degree + 1):
        carried = 0.0
        for j in range(order):
            lower_knot = degree + j - order
            share = local[j] / (near[degree + j] - near[lower_knot])
            local[j] = carried + above[j] * share
            carried = below[lower_knot] * share
        local[order] = carried
    values = np.zeros((at.size, size))
    values[np.arange(at.size), span - degree + np.arange(degree + 1)[:, None]] = local
    return values


@dataclass(frozen=True)
class PowerBasis:
    """Powers 1 … size of u / largest_us."""

    size: int  # highest power, and so the number of coefficients
    largest_us: float
    """Pulse width beyond which the curve is held, µs. It is scaled to 1, so that all powers have a similar size."""

    def design(self, pulse_width_us: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Powers (or a derivative) at pulse widths of any shape; shape (..., size)."""
        u = np.clip(np.asarray(pulse_width_us, float), 0.0, self.largest_us) / self.largest_us
        columns = []
        for p in range(1, self.size + 1):
            lead = float(np.prod(np.arange(p, p - derivative, -1))) if derivative else 1.0
            columns.append(lead * u ** max(p - derivative, 0) / self.largest_us**derivative)
        return np.stack(columns, axis=-1)

    def to_dict(self) -> dict:
        return {"kind": "power-series", "order": self.size, "scale_us": self.largest_us}


@dataclass(frozen=True)
class SigmoidBasis:
    """The sigmoid of equation (30) with its two shape parameters fixed: one coefficient, the gain a1 in N·m."""

    a2_per_us: float  # steepness, 1/µs, positive
    a3: float  # position: half of the gain is reached where e^{a2 u} = a3 + 2
    largest_us: float = 300.0  # largest pulse width it was fitted on, µs
    size: int = field(default=1, init=False)

    @classmethod
    def at(cls, log_steepness: float, middle_us: float, largest_us: float) -> SigmoidBasis:
        """The sigmoid by the log of its steepness and its middle, µs: parameters that suit a numerical search."""
        a2 = float(np.exp(log_steepness))
        return cls(a2, float(max(np.exp(min(a2 * middle_us, 600.0)) - 2.0, -0.999)), largest_us)

    def design(self, pulse_width_us: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Shape (..., 1); derivatives by the closed form, up to the second."""
        decay = np.exp(-self.a2_per_us * np.maximum(np.asarray(pulse_width_us, float), 0.0))
        bottom = 1.0 + self.a3 * decay
        value = (1.0 - decay) / bottom
        if derivative > 0:
            value = self.a2_per_us * (1.0 + self.a3) * decay / bottom**2
        if derivative == 2:
            value = value * self.a2_per_us * (self.a3 * decay - 1.0) / bottom
        return value[..., None]

    def to_dict(self) -> dict:
        return {"kind": "sigmoid", "a2_per_us": self.a2_per_us, "a3": self.a3, "largest_us": self.largest_us}


def basis_from_dict(data: dict[str, Any]) -> SplineBasis | PowerBasis | SigmoidBasis:
    """The basis that `to_dict` describes; that its kind is known, `identify.model_schema` sees to."""
    match data["kind"]:
        case "cubic-spline":
            return SplineBasis(np.asarray(data["knots_us"], float))
        case "power-series":
            return PowerBasis(int(data["order"]), float(data["scale_us"]))
        case _:
            return SigmoidBasis(float(data["a2_per_us"]), float(data["a3"]), float(data.get("largest_us", 300.0)))


def fit_sigmoid(
    residual_of: Callable[[SigmoidBasis], np.ndarray], widths_us: np.ndarray, largest_us: float
) -> SigmoidBasis:
    """Least-squares estimate of the two shape parameters: a coarse scan, then a bounded trust-region search.

    `residual_of` gives the residual for a shape, with all linear parameters solved for. The widths that were applied
    bound the middle.
    """
    from scipy.optimize import least_squares

    top = max(float(np.max(widths_us)), 1e-6)

    def residual(x: np.ndarray) -> np.ndarray:
        return residual_of(SigmoidBasis.at(x[0], x[1] * top, largest_us))

    steep, middle = (3.0, 6.0, 12.0, 25.0, 60.0), (0.15, 0.3, 0.45, 0.6, 0.8)
    scan = [np.array([np.log(rate / top), share]) for rate in steep for share in middle]
    best = scan[int(np.argmin([float(np.sum(residual(x) ** 2)) for x in scan]))]
    bounds = ([np.log(0.5 / top), 0.0], [np.log(2000.0 / top), 1.2])
    x = least_squares(residual, best, bounds=bounds, x_scale=[0.3, 0.05], xtol=1e-12, ftol=1e-14, gtol=1e-14).x
    return SigmoidBasis.at(x[0], x[1] * top, largest_us)

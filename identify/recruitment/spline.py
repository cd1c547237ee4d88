"""Cubic spline recruitment: equation (8) of the paper, in the basis of B-splines."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

DEGREE = 3


@dataclass(frozen=True)
class SplineBasis:
    """Cubic splines on given knots that vanish at zero pulse width.

    They are the same functions as in equation (8) of the paper. The cubes |u - u_i|³ used there are nearly collinear,
    and their normal equations lose half of the digits; B-splines lose none. f(0) = 0 holds because the one B-spline
    that is not zero there is left out.

    Parameters
    ----------
    knots_us : ndarray, shape (m,)
        Strictly increasing, µs, first 0, last the largest pulse width.
    """

    knots_us: np.ndarray

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

    @classmethod
    def from_dict(cls, data: dict) -> SplineBasis:
        return cls(np.asarray(data["knots_us"], float))


def bsplines(padded: np.ndarray, degree: int, at: np.ndarray, derivative: int = 0) -> np.ndarray:
    """B-splines, or their derivative, by the recursion of Cox and de Boor (de Boor 1978, ch. X); shape (N, size).

    Not from scipy.interpolate, whose import would add 0.2 s to every start of the command.

    Parameters
    ----------
    padded : ndarray
        Knots, with the outer ones repeated `degree` times.
    degree : int
        3 is cubic.
    at : ndarray, shape (N,)
        Places within the knots.
    derivative : int
        0 to `degree`.
    """
    if derivative:
        lower = bsplines(padded[1:-1], degree - 1, at, derivative - 1)
        gap = degree / (padded[degree + 1 : -1] - padded[1 : -degree - 1])
        edge = np.zeros((at.size, 1))
        scaled = np.concatenate([edge, lower * gap, edge], axis=1)
        return scaled[:, :-1] - scaled[:, 1:]
    size = padded.size - degree - 1
    span = np.clip(np.searchsorted(padded, at, side="right") - 1, degree, size - 1)
    local = np.zeros((at.size, degree + 1))
    local[:, 0] = 1.0
    for order in range(1, degree + 1):
        carried = np.zeros(at.size)
        for j in range(order):
            right, left = padded[span + j + 1], padded[span + j + 1 - order]
            share = local[:, j] / (right - left)
            local[:, j] = carried + (right - at) * share
            carried = (at - left) * share
        local[:, order] = carried
    values = np.zeros((at.size, size))
    np.put_along_axis(values, span[:, None] - degree + np.arange(degree + 1), local, axis=1)
    return values

"""A recruitment curve that never falls and lies near a known shape, as far as the data allow: a prior for short tests.

A recruitment curve is the sum of the motor units whose thresholds a pulse exceeds. So it is described by the density
of those thresholds: the steps between neighbouring coefficients of its spline, which are positive. The logarithm of a
step is that of a shape with three parameters (gain, middle, width) plus a deviation, a Gaussian process along the pulse
width. How large deviations are is estimated from the data (`DEVIATIONS`). Between two tested widths the curve stays
between its values there, and may do anything that the deviation allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stimrig.identify.recruitment.bases import SplineBasis

KNOTS, FINE_KNOTS = 61, 121
"""The second where the first leave a residual: at a sudden bend, or in a muscle of few large units."""


@dataclass(frozen=True)
class Deviation:
    """One kind of deviation of the log density from the shape."""

    sd: float  # its standard deviation
    smooth_share: float
    """Share of its variance that is smooth; the rest is rough, as from single large units or at a sudden beginning."""


DEVIATIONS = (Deviation(0.05, 1.0), Deviation(0.4, 0.8), Deviation(1.1, 0.8), Deviation(1.6, 0.0), Deviation(3.2, 0.2))
"""The first is the shape itself. With the last the density changes by a factor of 25 from place to place: a jump, a gap
between two groups of motor units, or single large units. Their probabilities come from the data."""
SMOOTH_LENGTH, ROUGH_LENGTH = 0.8, 0.4
"""Lengths over which the two parts change, relative to the rise from 10 to 90 %."""
BLUR = 0.12
"""Distance, relative to the rise, over which a step may be as large as its neighbours."""
LEAST_STEP = 1e-9
"""A step is at least this share of the gain, so that its logarithm exists."""

Shape = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""A shape in standard units: its value, from 0 to 1, and its slope."""


def logistic(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The paper's sigmoid in standard units: its steepness is 1 at the middle 0."""
    value = 0.5 * (1.0 + np.tanh(0.5 * x))
    return value, value * (1.0 - value)


LOGISTIC_RISE = 4.394
"""Distance from 10 to 90 % of `logistic`."""


@dataclass(frozen=True)
class NearShape:
    """The prior of a curve on a spline basis."""

    basis: SplineBasis  # of the curve; its coefficients are the running sums of the steps
    shape: Shape  # the shape in standard units, from 0 to 1: `logistic`, or an earlier curve
    mean: np.ndarray  # of log gain (N·m), middle (µs) and log width (µs), shape (3,)
    precision: np.ndarray  # of those three, shape (3, 3)
    plateau: tuple[float, float]
    """Mean and standard deviation of the log of the plateau, N·m: the sum of all steps, with their deviations."""
    rise_us: float  # rise from 10 to 90 %, µs: the scale of the deviation
    deviations: tuple[Deviation, ...] = DEVIATIONS  # kinds of the log density's deviation that are averaged over
    shape_covariance: np.ndarray | None = None
    """Covariance of the logs of the steps of the shape itself, where the shape is an estimate; shape (n, n)."""

    @cached_property
    def places_us(self) -> np.ndarray:
        """Where the spline's coefficients are (Greville's abscissae), with 0 first, shape (n + 1,)."""
        padded = np.r_[[0.0] * 3, self.basis.knots_us, [self.basis.largest_us] * 3]
        return np.convolve(padded[1:-1], np.ones(3) / 3.0, mode="valid")

    def log_steps(self, three: np.ndarray) -> np.ndarray:
        """Logarithms of the steps of the shape itself, shape (..., n), for (log gain, middle, log width)."""
        return self.log_steps_and_slopes(three)[0]

    def log_steps_and_slopes(self, three: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """`log_steps`, and its derivatives by middle and log width, each of shape (..., n); that by log gain is 1."""
        width = np.exp(three[..., 2:3])
        x = (self.places_us - three[..., 1:2]) / width
        share, slope = self.shape(x)
        step = share[..., 1:] - share[..., :-1] + LEAST_STEP
        turned = x * slope
        by_middle = (slope[..., :-1] - slope[..., 1:]) / (width * step)
        by_width = (turned[..., :-1] - turned[..., 1:]) / step
        return three[..., :1] + np.log(step), (by_middle, by_width)

    @cached_property
    def roots(self) -> tuple[np.ndarray, ...]:
        """A root of the covariance of each kind of deviation, shape (n, n)."""
        at = 0.5 * (self.places_us[1:] + self.places_us[:-1])
        away = np.abs(at[:, None] - at[None, :]) / self.rise_us
        scaled = np.sqrt(3.0) * away / SMOOTH_LENGTH
        smooth, rough = (1.0 + scaled) * np.exp(-scaled), np.exp(-away / ROUGH_LENGTH)
        roots = []
        for kind in self.deviations:
            covariance = kind.smooth_share * smooth + (1.0 - kind.smooth_share) * rough
            covariance = kind.sd**2 * (covariance + 1e-9 * np.eye(at.size))
            if self.shape_covariance is not None:
                covariance = covariance + self.shape_covariance
            roots.append(np.linalg.cholesky(covariance))
        return tuple(roots)

    def blurred(self, steps: np.ndarray) -> np.ndarray:
        """Largest plausible steps, by each step itself and by the density of its neighbours, shape (n,).

        Beside a jump of the density a step is small, but where exactly the jump is is not known: the small steps there
        may be as large as their neighbours.
        """
        return np.maximum(steps, self._blur @ steps)

    @cached_property
    def _blur(self) -> np.ndarray:
        gaps = np.diff(self.places_us)
        at = 0.5 * (self.places_us[1:] + self.places_us[:-1])
        weight = np.exp(-0.5 * ((at[:, None] - at[None, :]) / (BLUR * self.rise_us)) ** 2) * gaps[None, :]
        return gaps[:, None] * (weight / weight.sum(axis=1)[:, None]) / gaps[None, :]


def dense_knots(largest_us: float, middle_us: float, rise_us: float, count: int = KNOTS) -> np.ndarray:
    """Knots from 0 to the largest width, a third of them even, the others denser where the curve rises."""
    u = np.linspace(0.0, largest_us, 601)
    dense = 1.0 / (1.0 + ((u - middle_us) / (0.8 * rise_us)) ** 2)
    density = 1.0 / 3.0 / largest_us + 2.0 / 3.0 * dense / np.trapezoid(dense, u)
    mass = np.r_[0.0, np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(u))]
    knots = np.interp(np.linspace(0.0, mass[-1], count), mass, u)
    knots[0], knots[-1] = 0.0, largest_us
    return knots


PLATEAU_LOG_SD = 0.4
"""A plateau is hardly ever more than twice the largest torque that was seen."""


def new_person(basis: SplineBasis, rise_us: float, scale_nm: float) -> NearShape:
    """The prior of the curve of somebody who was never tested; `scale_nm` is the largest torque seen, N·m."""
    largest_us = basis.largest_us
    mean = np.array([np.log(scale_nm), 0.45 * largest_us, np.log(largest_us / 20.0)])
    precision = np.diag(1.0 / np.array([1.0, 0.35 * largest_us, 1.0]) ** 2)
    return NearShape(basis, logistic, mean, precision, (float(np.log(scale_nm)) + 0.1, PLATEAU_LOG_SD), rise_us)

"""What a short record shows: draws of the curve and of the dynamics, and the fit from which they were drawn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.dynamics.pulse_grid import Grid
from stimrig.identify.estimation.curve_posterior import Mode
from stimrig.identify.noise.level import NoiseLevel
from stimrig.identify.recruitment.spline import SplineBasis


@dataclass(frozen=True)
class Short:
    """What a short record shows.

    Parameters
    ----------
    grid : Grid
        The record on the grid of pulses.
    rows : ndarray of bool, shape (K,)
        Intervals that were fitted.
    basis : SplineBasis
        Of the curve.
    sign : float
        1 where stimulation raises the record's torque, -1 where it lowers it.
    linear : SecondOrder
        The most probable dynamics.
    coefficients_nm : ndarray, shape (S, n)
        Draws of the curve's coefficients, positive as the muscle pulls, N·m.
    dynamics : ndarray, shape (S, 3)
        Draws of T, s, ζ and the delay, s.
    others_nm : ndarray, shape (S, E)
        Draws of the baselines and initial states (torque, N·m, and rate, N·m/s).
    modes : tuple of Mode
        One for each kind of the curve's deviation from the known shape.
    weights : ndarray, shape (M,)
        Their probabilities.
    noise : NoiseLevel
        Of the intervals' means.
    residual_nm : ndarray, shape (K,)
        Measured minus the most probable model, N·m.
    three : ndarray, shape (3,)
        Log gain, middle and log width at the most probable mode.
    likely : ndarray, shape (n + E,)
        Steps of the curve, baselines and initial states at the most probable mode.
    rise_us : float
        Rise from 10 to 90 % for which the knots were made, µs.
    strange : float
        Probability that the curve is far from the known shape.
    """

    grid: Grid
    rows: np.ndarray
    basis: SplineBasis
    sign: float
    linear: SecondOrder
    coefficients_nm: np.ndarray
    dynamics: np.ndarray
    others_nm: np.ndarray
    modes: tuple[Mode, ...]
    weights: np.ndarray
    noise: NoiseLevel
    residual_nm: np.ndarray
    three: np.ndarray
    likely: np.ndarray
    rise_us: float
    strange: float

    @property
    def largest_us(self) -> float:
        """Largest width of the curve, µs."""
        return self.basis.largest_us

    @cached_property
    def mean_nm(self) -> np.ndarray:
        """Mean of the curve's coefficients, N·m."""
        return self.coefficients_nm.mean(axis=0)

    @cached_property
    def plateau_nm(self) -> float:
        """The mean curve at its largest width, N·m."""
        return float(self.mean_nm[-1])

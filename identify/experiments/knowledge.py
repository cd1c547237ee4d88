"""What is known of a muscle: bands of both curves that contain the whole true curve in 95 % of tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.identify.estimation.short_record import Short

POINTS = 61
LEVEL = 0.95
EVEN = 0.9
"""The band is at least about this share of its largest width everywhere: where a curve has a sudden bend, the draws
know its place too well."""
HIDDEN = 0.25
"""Share by which bands are widened for what the draws cannot know: a sudden beginning of recruitment, which no smooth
density has, and its effect on the dynamics. The curve's band is widened where the curve is far from the known shape.
Without it, and with bands less even, each band contained its true curve in 30 of 33 development patients (seeds
50200 to 50232, shaped curves)."""
LEAST_SD = 1e-4
"""Standard deviations below this share of the plateau count as this share, so that a point that is known exactly (zero
at zero width) does not decide."""


@dataclass(frozen=True)
class Band:
    """A curve with its whole band.

    Parameters
    ----------
    at : ndarray, shape (B,)
        Pulse widths, µs, or times, s.
    value, half : ndarray, shape (B,)
        The curve and the half-width of its band, as shares of the plateau.
    """

    at: np.ndarray
    value: np.ndarray
    half: np.ndarray

    @property
    def percent(self) -> float:
        """Largest half-width, % of the plateau."""
        return 100.0 * float(np.max(self.half))


@dataclass(frozen=True)
class Knowledge:
    """Bands of both curves.

    Parameters
    ----------
    curve : Band
        f(u), as a share of the plateau.
    step : Band
        Response to a unit step.
    plateau_nm : float
        f at the largest width, N·m, positive.
    """

    curve: Band
    step: Band
    plateau_nm: float

    def to_dict(self) -> dict:
        """Plain values for a page: bands in N·m and as shares."""
        unit = self.plateau_nm
        curve, step = self.curve, self.step
        return {
            "plateau_nm": unit,
            "curve_percent": curve.percent,
            "step_percent": step.percent,
            "recruitment": {
                "pulse_width_us": curve.at.tolist(),
                "torque_nm": (unit * curve.value).tolist(),
                "lower_nm": (unit * (curve.value - curve.half)).tolist(),
                "upper_nm": (unit * (curve.value + curve.half)).tolist(),
            },
            "step_response": {
                "time_s": step.at.tolist(),
                "value": step.value.tolist(),
                "lower": (step.value - step.half).tolist(),
                "upper": (step.value + step.half).tolist(),
            },
        }


def knowledge(short: Short) -> Knowledge:
    """The bands that the draws of a fit give."""
    width = np.linspace(0.0, short.basis.largest_us, POINTS)
    plateau = max(short.plateau_nm, 1e-9)
    curves = short.coefficients_nm @ short.basis.design(width).T / plateau
    time_s = np.linspace(0.0, min(short.linear.memory_s, 12.0), POINTS)
    return Knowledge(
        curve=whole_band(width, curves, 1.0 + HIDDEN * short.strange),
        step=whole_band(time_s, step_responses(short.dynamics, time_s), 1.0 + HIDDEN),
        plateau_nm=plateau,
    )


def whole_band(at: np.ndarray, draws: np.ndarray, factor: float = 1.0) -> Band:
    """The band about the mean in which 95 % of the drawn curves lie as a whole, times a factor."""
    mean, sd = draws.mean(axis=0), np.maximum(draws.std(axis=0), LEAST_SD)
    sd = np.hypot(sd, EVEN * sd.max())
    farthest = np.max(np.abs(draws - mean) / sd, axis=1)
    return Band(at, mean, factor * float(np.quantile(farthest, LEVEL)) * sd)


def step_responses(dynamics: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Responses to a unit step of many (T, ζ, delay), shape (S, len(time_s))."""
    t = np.maximum(time_s[None, :] - dynamics[:, 2:3], 0.0) / dynamics[:, :1]
    zeta = dynamics[:, 1:2]
    gap = zeta * zeta - 1.0
    root = np.sqrt(np.where(np.abs(gap) < 1e-6, 1e-6, gap).astype(complex))
    p, q = -zeta + root, -zeta - root
    return np.real(1.0 + (q * np.exp(p * t) - p * np.exp(q * t)) / (p - q))

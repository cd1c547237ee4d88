"""Uncertainty of a muscle's curves, and its expected fall by each candidate piece of a test.

Bands of both curves contain the whole true curve in 95 % of tests. For what pieces would teach, the draws' principal
directions are few: the response to a piece is computed for the mean and for each direction, and the directions'
covariance is updated as by a linear measurement; hundreds of pieces are so compared within milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from stimrig.identify.dynamics.linear import step_responses
from stimrig.identify.dynamics.second_order import FROM_START, held_states, step_matrix
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.short_record import Short
from stimrig.identify.experiments.designs import Segment

POINTS = 61
LONGEST_S = 12.0
"""Longest part of a step response that is judged, s."""
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
DIRECTIONS = 24
NORM = 6
"""Widths of the bands are combined by this norm: the widest places count most, but not alone."""
WIDTHS_SD = 3.0
"""Half of a whole band, in standard deviations, where no draws tell it."""
LEAST_PERCENT, MOST_PERCENT = 0.2, 50.0


def require_number(value: object, place: str, what: str, fix: str, lower: float, upper: float) -> None:
    """Raise BadRequest unless a value is a number within bounds, both included."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not lower <= value <= upper:
        raise BadRequest(f"{value!r} is {what}", place=place, fix=fix)


@dataclass(frozen=True)
class Target:
    """Largest half-widths of the 95 % bands of whole curves. Raises BadRequest: not a number from 0.2 to 50."""

    curve_percent: float = 2.0  # of the recruitment curve f(u), as a share of its plateau
    step_percent: float = 2.0  # of the response to a unit step

    def __post_init__(self) -> None:
        fix = f"Give a number from {LEAST_PERCENT:g} to {MOST_PERCENT:g} %."
        for name, value in vars(self).items():
            require_number(value, f"target.{name}", "no target", fix, LEAST_PERCENT, MOST_PERCENT)


@dataclass(frozen=True)
class Band:
    """A curve with its whole band; arrays of shape (B,)."""

    at: np.ndarray  # pulse widths, µs, or times, s
    value: np.ndarray  # as a share of the plateau
    half: np.ndarray  # half-width of the band, as such a share

    @property
    def percent(self) -> float:
        """Largest half-width, % of the plateau."""
        return 100.0 * float(np.max(self.half))


@dataclass(frozen=True)
class Knowledge:
    """Bands of both curves."""

    curve: Band  # f(u), as a share of the plateau
    step: Band  # response to a unit step
    plateau_nm: float  # f at the largest width, positive

    def reaches(self, target: Target) -> bool:
        """Return true if both bands are within the target."""
        return self.curve.percent <= target.curve_percent and self.step.percent <= target.step_percent

    def to_dict(self) -> dict:
        """Plain values for a page: bands in N·m and as shares."""
        unit, curve, step = self.plateau_nm, self.curve, self.step
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
    time_s = np.linspace(0.0, min(short.linear.memory_s, LONGEST_S), POINTS)
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


# ---- what pieces would teach ----


def foresee(
    short: Short, played_us: np.ndarray, target: Target, candidates: list[Segment]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Width of the bands now and after each candidate, in the norm of this module; and the candidate's dose, N·m·s.

    `played_us`: widths of all pulses that are played or committed. What is not known has D directions: the first of
    1 + D rows is the mean, each other one is the mean moved along a direction by one standard deviation.
    """
    draws = np.c_[short.coefficients_nm, np.log(short.dynamics[:, :2]), short.dynamics[:, 2]]
    mean = draws.mean(axis=0)
    scale = np.r_[np.full(short.basis.size, short.plateau_nm), 1.0, 1.0, 0.02]
    _, size, right = np.linalg.svd((draws - mean) / scale, full_matrices=False)
    largest = np.take_along_axis(right, np.abs(right).argmax(axis=1)[:, None], 1)
    right *= np.sign(largest)  # the same on any computer
    directions = min(DIRECTIONS, int(np.sum(size > 1e-9 * size[0])))
    moved = mean + (size[:directions, None] / np.sqrt(len(draws))) * right[:directions] * scale
    rows = np.vstack([mean, moved])
    curves, cores = rows[:, :-3], np.c_[np.exp(rows[:, -3:-1]), rows[:, -1]]  # of T, ζ, delay
    known = knowledge(short)
    design = short.basis.design(known.curve.at).T / short.plateau_nm
    f, steps = curves @ design, step_responses(cores, known.step.at)
    # standard deviations in the half-width of the whole band
    sd = (draws[:, :-3] @ design).std(axis=0)
    at = int(np.argmax(sd))
    factor = float(np.clip(known.curve.half[at] / max(sd[at], 1e-12), 2.0, 8.0))
    of_curve = (f[1:] - f[0]).T * (factor * 100.0 / target.curve_percent)
    of_step = (steps[1:] - steps[0]).T * (WIDTHS_SD * 100.0 / target.step_percent)
    # what a direction moves: points of both curves, divided by the target, shape (B, D)
    targets = np.vstack([of_curve, of_step])
    # torque, N·m, and its rate, N·m/s, when the next piece begins, shape (1 + D, 2)
    step_s = short.grid.step_s
    even = np.array([step_matrix(t, z, step_s) for t, z in cores[:, :2]])
    drive = np.ascontiguousarray(curves @ short.basis.design(played_us).T)
    torque, rate = held_states(drive, even, FROM_START, np.zeros((len(cores), 1, 2)))
    states = np.c_[torque[:, -1], rate[:, -1]]
    widths = [np.array(piece.settings["pulse_width_us"]) for piece in candidates]
    places = np.cumsum([0, *(w.size for w in widths)]).astype(np.int64)
    levels, index = np.unique(np.concatenate(widths), return_inverse=True)
    level_nm = np.ascontiguousarray(curves @ short.basis.design(levels).T)
    information = _information(level_nm, index, places, cores, states, step_s) / short.noise.sd_nm**2
    covariance = np.linalg.inv(np.eye(directions) + information)
    variance = np.einsum("bi,cij,bj->cb", targets, covariance, targets, optimize=True)
    dose = np.add.reduceat(level_nm[0][index], places[:-1]) * step_s
    return float(_norm(np.sum(targets**2, axis=1)[None, :])[0]), _norm(np.maximum(variance, 0.0)), dose


def _norm(variance: np.ndarray) -> np.ndarray:
    half = np.sqrt(variance)
    first, second = half[:, :POINTS], half[:, POINTS:]
    return np.sum(first**NORM, axis=1) ** (1 / NORM) + np.sum(second**NORM, axis=1) ** (1 / NORM)


@njit(cache=True, nogil=True)
def _information(curves, index, places, cores, states, step_s):  # pragma: no cover
    """Sum over the intervals of a piece of slopes by the directions, outer product, shape (C, D, D), N²·m²."""
    count, size = places.size - 1, cores.shape[0] - 1
    out = np.zeros((count, size, size))
    even = np.empty((size + 1, 4))
    for m in range(size + 1):
        even[m] = step_matrix(cores[m, 0], cores[m, 1], step_s)
    slope = np.empty(size)
    for c in range(count):
        y, v = states[:, 0].copy(), states[:, 1].copy()
        for k in range(places[c], places[c + 1]):
            reference = 0.0
            for m in range(size + 1):
                w, before = curves[m, index[k]], y[m]
                y[m] = w + even[m, 0] * (before - w) + even[m, 1] * v[m]
                v[m] = even[m, 2] * (before - w) + even[m, 3] * v[m]
                # The mean over the interval, read a delay earlier.
                mean = 0.5 * (before + y[m]) - cores[m, 2] * v[m]
                if m == 0:
                    reference = mean
                else:
                    slope[m - 1] = mean - reference
            for i in range(size):
                for j in range(i + 1):
                    out[c, i, j] += slope[i] * slope[j]
        for i in range(size):
            for j in range(i):
                out[c, j, i] = out[c, i, j]
    return out

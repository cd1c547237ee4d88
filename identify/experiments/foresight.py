"""What pieces of a test would teach: the bands that are expected after each, from draws of what is known now.

The draws' principal directions are few. The response to a piece is computed for the mean and for each direction, and
the directions' covariance is updated as by a linear measurement; hundreds of pieces are so compared within
milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from stimrig.identify.dynamics.states import FROM_START, held_states, step_matrix
from stimrig.identify.estimation.short_record import Short
from stimrig.identify.experiments.designs import Piece
from stimrig.identify.experiments.knowledge import POINTS, knowledge, step_responses
from stimrig.identify.experiments.target import Target

DIRECTIONS = 24
NORM = 6
"""Widths of the bands are combined by this norm: the widest places count most, but not alone."""
WIDTHS_SD = 3.0
"""Half of a whole band, in standard deviations, where no draws tell it."""


@dataclass(frozen=True)
class Foresight:
    """Directions of what is not known, with the muscle's state at the end of what is planned.

    Parameters
    ----------
    coefficients_nm : ndarray, shape (1 + D, n)
        Curves: the mean, then the mean moved along each direction by one standard deviation.
    cores : ndarray, shape (1 + D, 3)
        T, ζ, delay of each.
    states : ndarray, shape (1 + D, 2)
        Torque, N·m, and its rate, N·m/s, of each when the next piece begins.
    targets : ndarray, shape (B, D)
        What a direction moves: points of both curves, divided by the target.
    noise_nm : float
        Of an interval's mean, N·m.
    short : Short
        The fit.
    """

    coefficients_nm: np.ndarray
    cores: np.ndarray
    states: np.ndarray
    targets: np.ndarray
    noise_nm: float
    short: Short

    @classmethod
    def of(cls, short: Short, played_us: np.ndarray, target: Target) -> Foresight:
        """From a fit, the widths of all pulses that are played or committed, and the target."""
        draws = np.c_[short.coefficients_nm, np.log(short.dynamics[:, :2]), short.dynamics[:, 2]]
        mean = draws.mean(axis=0)
        scale = np.r_[np.full(short.basis.size, short.plateau_nm), 1.0, 1.0, 0.02]
        left, size, right = np.linalg.svd((draws - mean) / scale, full_matrices=False)
        del left
        kept = min(DIRECTIONS, int(np.sum(size > 1e-9 * size[0])))
        moved = mean + (size[:kept, None] / np.sqrt(len(draws))) * right[:kept] * scale
        rows = np.vstack([mean, moved])
        cores = np.c_[np.exp(rows[:, -3:-1]), rows[:, -1]]
        curves = rows[:, :-3]
        known = knowledge(short)
        width, time_s = known.curve.at, known.step.at
        f = curves @ short.basis.design(width).T / short.plateau_nm
        steps = step_responses(cores, time_s)
        factor = _factor(known.curve.half, draws[:, :-3] @ short.basis.design(width).T / short.plateau_nm)
        targets = np.vstack(
            [
                (f[1:] - f[0]).T * (factor * 100.0 / target.curve_percent),
                (steps[1:] - steps[0]).T * (WIDTHS_SD * 100.0 / target.step_percent),
            ]
        )
        design = short.basis.design(played_us)
        even = np.array([step_matrix(t, z, short.grid.step_s) for t, z in cores[:, :2]])
        drive = np.ascontiguousarray(curves @ design.T)
        torque, rate = held_states(drive, even, FROM_START, np.zeros((len(cores), 1, 2)))
        return cls(curves, cores, np.c_[torque[:, -1], rate[:, -1]], targets, short.noise.sd_nm, short)

    @property
    def now(self) -> float:
        """Present width of the bands relative to the target, in the norm of this module."""
        return _norm(np.sum(self.targets**2, axis=1)[None, :])[0]

    def after(self, candidates: list[Piece]) -> tuple[np.ndarray, np.ndarray]:
        """Expected width of the bands after each piece, in the norm of this module, and its dose, N·m·s."""
        step_s = self.short.grid.step_s
        widths = [piece.pulse_width_us for piece in candidates]
        places = np.cumsum([0, *(w.size for w in widths)]).astype(np.int64)
        levels, index = np.unique(np.concatenate(widths), return_inverse=True)
        curves = np.ascontiguousarray(self.coefficients_nm @ self.short.basis.design(levels).T)
        information = _information(curves, index, places, self.cores, self.states, step_s)
        size = len(self.cores) - 1
        left = np.linalg.inv(np.eye(size) + information / self.noise_nm**2)
        variance = np.einsum("bi,cij,bj->cb", self.targets, left, self.targets, optimize=True)
        dose = np.add.reduceat(curves[0][index], places[:-1]) * step_s
        return _norm(np.maximum(variance, 0.0)), dose


def _factor(half: np.ndarray, draws: np.ndarray) -> float:
    """Standard deviations in the half-width of the whole band."""
    sd = draws.std(axis=0)
    at = int(np.argmax(sd))
    return float(np.clip(half[at] / max(sd[at], 1e-12), 2.0, 8.0))


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
            seen = 0.0
            for m in range(size + 1):
                w, before = curves[m, index[k]], y[m]
                y[m] = w + even[m, 0] * (before - w) + even[m, 1] * v[m]
                v[m] = even[m, 2] * (before - w) + even[m, 3] * v[m]
                # The mean over the interval, read a delay earlier.
                mean = 0.5 * (before + y[m]) - cores[m, 2] * v[m]
                if m == 0:
                    seen = mean
                else:
                    slope[m - 1] = mean - seen
            for i in range(size):
                for j in range(i + 1):
                    out[c, i, j] += slope[i] * slope[j]
        for i in range(size):
            for j in range(i):
                out[c, j, i] = out[c, i, j]
    return out

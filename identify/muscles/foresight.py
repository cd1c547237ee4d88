"""What is known of several muscles after a joint fit, and what a piece of a test would teach of each.

The fit is linearised at its optimum: bands of all curves follow from the covariance of all parameters, and a piece adds
the information of its own response. So what one muscle hides of the other one counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from stimrig.identify.dynamics.linear import SecondOrder, step_responses
from stimrig.identify.estimation.uncertainty import whole_factor
from stimrig.identify.experiments.knowledge import HIDDEN, LEAST_SD, LONGEST_S, NORM, POINTS, Band, Knowledge, Target
from stimrig.identify.muscles.joint_fit import JointFitted, assemble
from stimrig.identify.muscles.pieces import Piece
from stimrig.identify.muscles.problem import JointProblem
from stimrig.identify.muscles.record import JointRecord
from stimrig.identify.noise import whitened
from stimrig.identify.records.record import Record

CHANGE = 1e-3
"""Of the logarithm of the time constant and of the damping, for derivatives."""
SAMPLES = 4
"""Per pulse of a piece that is simulated."""
APART_S = 1.5
OWN = 3
"""Parameters of a muscle's dynamics: the logarithms of time constant and damping, and the delay."""


class Foresight:
    """All muscles of a joint fit."""

    def __init__(self, found: JointFitted) -> None:
        self.found, self.fitted = found, found.fitted
        self.muscles = [_Muscle(found, place) for place in range(len(found.grids))]
        # Parameters are of very different sizes.
        self.scale = 1.0 / np.sqrt(np.maximum(np.diag(self.fitted.hessian), 1e-300))
        known = self.fitted.hessian * self.scale[:, None] * self.scale
        self.known = known + 1e-9 * np.eye(self.scale.size)
        self.root = self.scale[:, None] * np.linalg.inv(np.linalg.cholesky(self.known)).T

    @cached_property
    def knowledge(self) -> tuple[Knowledge, ...]:
        """The bands of each muscle."""
        return tuple(muscle.knowledge(self.root) for muscle in self.muscles)

    def targets(self, target: Target) -> np.ndarray:
        """Derivatives of all curves by the scaled parameters, so that half a band as wide as the target is 1."""
        rows = []
        for muscle, known in zip(self.muscles, self.knowledge, strict=True):
            for slopes, band, percent in (
                (muscle.curve_slopes, known.curve, target.curve_percent),
                (muscle.step_slopes, known.step, target.step_percent),
            ):
                sd = np.maximum(np.linalg.norm(slopes @ self.root, axis=1), LEAST_SD)
                rows.append(slopes * (band.half / sd)[:, None] * 100.0 / percent)
        return np.concatenate(rows) * self.scale

    def after(self, pieces: Sequence[Piece], target: Target) -> tuple[float, np.ndarray]:
        """Width of the bands now, and expected after each piece, over the target, in a norm."""
        targets = self.targets(target)
        now = _norm(np.sum((targets @ np.linalg.inv(self.known)) * targets, axis=1))
        simulated, begins, stops = self._laid(pieces)
        _, slopes = simulated.run(self.fitted.theta, derivatives=True)
        assert slopes is not None
        for part, place in zip(simulated.parts, simulated.places, strict=True):
            slopes[place.start + np.array(part.initials)] = 0.0  # a piece does not begin where the test began
        white, after, at = whitened(slopes, (begins, stops), self.fitted.noise), [], 0
        for size in stops - begins:
            own = white[:, at : at + size] * self.scale[:, None]
            left = np.linalg.solve(self.known + own @ own.T, targets.T)
            after.append(_norm(np.sum(targets * left.T, axis=1)))
            at += size
        return now, np.array(after)

    def doses(self, pieces: Sequence[Piece]) -> np.ndarray:
        """Torque-time of each muscle in each piece at most, by the upper end of its band, N·m·s, shape (M, C)."""
        simulated, begins, _ = self._laid(pieces)
        step_s, found = simulated.setup.grid.step_s, []
        _, torques = simulated.whole_and_parts(self.fitted.theta)
        for torque, known, column in zip(torques, self.knowledge, self._widths(pieces).T, strict=True):
            mean = np.abs(torque).reshape(-1, SAMPLES).mean(axis=1)
            doubt = known.plateau_nm * np.interp(column, known.curve.at, known.curve.half) * (column > 0.0)
            found.append(step_s * np.add.reduceat((1.0 + HIDDEN) * mean + doubt, begins))
        return np.stack(found, axis=1)

    def _widths(self, pieces: Sequence[Piece]) -> np.ndarray:
        """Of all pieces with a rest after each, so that none begins with what another one left, shape (K, C)."""
        rest = np.zeros((round(APART_S / self.found.grids[0].step_s), len(self.muscles)))
        return np.concatenate([np.concatenate([piece.pulse_width_us, rest]) for piece in pieces])

    def _laid(self, pieces: Sequence[Piece]) -> tuple[JointProblem, np.ndarray, np.ndarray]:
        """The fit's own equations on pieces one behind the other, and where each begins and ends."""
        record, widths_us = self.found.record, self._widths(pieces)
        rate = 1.0 / self.found.grids[0].step_s
        time_s = np.arange(len(widths_us) * SAMPLES) / (rate * SAMPLES)
        records = tuple(
            Record.from_arrays(time_s, np.repeat(own, SAMPLES), np.zeros(time_s.size), pulse_rate_hz=rate)
            for own in widths_us.T
        )
        grids = JointRecord(record.channels, records).grids
        setups = [
            setup.with_(grid=grid, target_nm=np.zeros(grid.size), fitted=np.ones(grid.size, bool), spread=1.0)
            for setup, grid in zip(self.found.setups, grids, strict=True)
        ]
        sizes = np.array([len(piece.pulse_width_us) for piece in pieces], np.int64)
        stops = np.cumsum(sizes + round(APART_S * rate)) - round(APART_S * rate)
        return assemble(setups, self.found.effects, self.found.acting), stops - sizes, stops


def _norm(variance: np.ndarray) -> float:
    """The widest places of all curves count most, but not alone."""
    half = np.sqrt(np.maximum(variance, 0.0))
    return float(np.sum(half**NORM) ** (1 / NORM))


class _Muscle:
    """One muscle of a joint fit, linearised."""

    def __init__(self, found: JointFitted, place: int) -> None:
        self.part, at = found.problem.parts[place], found.problem.places[place]
        self.first, self.size = at.start, found.problem.size
        values = self.part.physical(found.fitted.theta[at])
        self.core, self.coefficients_nm = values[:OWN], values[self.part.coefficients]
        self.basis, self.step_s = self.part.setup.basis, self.part.setup.grid.step_s
        self.places = np.r_[0:OWN, self.part.coefficients]
        self.widths_us = np.linspace(0.0, self.basis.largest_us, POINTS)
        memory_s = SecondOrder(*(float(value) for value in values[:2])).memory_s
        self.times_s = np.linspace(0.0, min(memory_s, LONGEST_S), POINTS)
        self.plateau_nm = max(float(np.max(self.basis.design(self.widths_us) @ self.coefficients_nm)), 1e-9)

    def _spread(self, own: np.ndarray) -> np.ndarray:
        """Derivatives by this muscle's parameters, as such by all."""
        slopes = np.zeros((len(own), self.size))
        slopes[:, self.first + self.places] = own
        return slopes

    @cached_property
    def curve_slopes(self) -> np.ndarray:
        """Of the curve as a share of the plateau, shape (POINTS, all parameters)."""
        design = self.basis.design(self.widths_us) / self.plateau_nm
        return self._spread(np.c_[np.zeros((POINTS, OWN)), design])

    @cached_property
    def step_slopes(self) -> np.ndarray:
        """Of the step response."""
        moved = np.tile(self.core, (1 + OWN, 1))
        moved[[1, 2], [0, 1]] *= np.exp(CHANGE)
        moved[3, 2] += CHANGE * self.step_s
        responses = step_responses(moved, self.times_s)
        slopes = (responses[1:] - responses[0]) / (CHANGE * np.array([1.0, 1.0, self.step_s]))[:, None]
        return self._spread(np.c_[slopes.T, np.zeros((POINTS, self.coefficients_nm.size))])

    def knowledge(self, root: np.ndarray) -> Knowledge:
        curve = self.basis.design(self.widths_us) @ self.coefficients_nm / self.plateau_nm
        step = step_responses(self.core[None, :], self.times_s)[0]
        bands = [
            Band(at, value, _half(slopes @ root))
            for at, value, slopes in (
                (self.widths_us, curve, self.curve_slopes),
                (self.times_s, step, self.step_slopes),
            )
        ]
        return Knowledge(*bands, plateau_nm=self.plateau_nm)


def _half(spread: np.ndarray) -> np.ndarray:
    """Half of the whole band, from a root of the covariance on the curve."""
    sd = np.linalg.norm(spread, axis=1)
    return (1.0 + HIDDEN) * whole_factor(spread @ spread.T, sd) * np.maximum(sd, LEAST_SD)

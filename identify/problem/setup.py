"""Set-up shared by all candidates of a record: grid, scenes, recruitment spline with its penalty, delay bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid, ends_of
from stimrig.identify.dynamics.terms import REACH
from stimrig.identify.effects.base import Scene
from stimrig.identify.noise import NoiseLevel, whitened
from stimrig.identify.records.joint_motion import MOTION, JointMotion
from stimrig.identify.recruitment import Basis

SETTINGS = (
    "scale_nm", "noise_sd_nm", "zero_nm", "sign", "reference_s", "reference_rad", "angle_range_rad", "angle_late_s",
)  # fmt: skip
"""Fields of a `Setup` that MODEL.json keeps beside an effect."""
TABLE = 271
"""Widths at which the curve is tabled for what changes them."""
WITHIN = 5
"""A joint that turns round within a pulse interval has dry friction on both sides: the middle knows one of them."""


def extended(basis: Basis, width_us: np.ndarray) -> np.ndarray:
    """Basis functions at widths that a drift may have moved beyond the largest; continued linearly; shape (K, n)."""
    top = basis.largest_us
    design = basis.design(width_us)
    over = np.clip(width_us - top, 0.0, (REACH - 1.0) * top)
    if np.any(over > 0.0):
        end = np.array([top])
        design = design + over[:, None] * basis.design(end, 1)
    return design


@dataclass(frozen=True)
class Setup:
    """A record prepared for fitting."""

    grid: Grid  # the record on the grid of pulses
    target_nm: np.ndarray
    """Torque to be explained, N·m, shape (K,): without hum, relative to `zero_nm`, and positive in the direction in
    which the muscle pulls; NaN where there is none."""
    fitted: np.ndarray  # intervals that are fitted, bool, shape (K,)
    basis: Basis  # of the recruitment curve, common to all candidates
    scale_nm: float  # largest torque, smoothed, N·m
    delay_bounds_s: tuple[float, float]
    """Bounds of the delay that every candidate has: about one sample in both directions."""
    roughness: np.ndarray | float = 0.0
    """Prior precision of the curve's coefficients, 1/(N·m)², which limits how much it bends; shape (n, n)."""
    noise_sd_nm: float = 0.0  # white noise of a sample, N·m
    zero_nm: float = 0.0  # zero of the record's torque, N·m
    sign: float = 1.0  # 1 where stimulation raises the record's torque, -1 where it lowers it
    spread: np.ndarray | float = 1.0
    """Noise of each interval, shape (K,), divided by the mean noise: each part of a record has its own noise."""
    reference_s: float = 0.0  # time at which the recruitment curve holds, if an effect makes it drift, s
    curve_nm: np.ndarray | float = 0.0  # prior mean of the curve's coefficients, N·m, shape (n,), or of each
    reference_rad: float | None = None  # angle at which the curve holds as it stands, rad (`Scene.reference_rad`)
    angle_range_rad: tuple[float, float] | None = None  # smallest and largest angle that was fitted, rad
    rests_nm: tuple[np.ndarray, np.ndarray] | None = None
    """Zero of each part as its rests show it, as the target is given, and its sd; None where they say nothing."""
    states: Mapping[str, float] = field(default_factory=dict)
    """By effect id, where its slow state begins; 0 (rested) where there is none."""
    angle_late_s: float = 0.0  # delay of the sensor of the angle, s
    motion: JointMotion | None = None  # in place of the record's own

    @cached_property
    def stretches(self) -> tuple[np.ndarray, np.ndarray]:
        """Starts and ends of the runs of fitted intervals, each within one part."""
        return ends_of(self.grid.stretches(self.fitted))

    def whitened(self, rows: np.ndarray, noise: NoiseLevel) -> np.ndarray:
        """Rows, shape (M, K), over the noise of their part, whitened to unit variance; fitted intervals in order."""
        return whitened(rows / self.spread, self.stretches, noise)

    def part_of(self, at_samples: bool) -> np.ndarray | None:
        """Index of the part of each sample or interval; None if there is one part only."""
        if self.grid.begins.size == 1:
            return None
        return self.grid.part[self.grid.interval] if at_samples else self.grid.part

    @cached_property
    def scene(self) -> Scene:
        """At the middle of the samples of each interval."""
        grid = self.grid
        scene = self._scene((np.arange(grid.size) + self._middle) * grid.step_s, grid.pulse_width_us, grid.begins)
        pauses = np.zeros(grid.size)
        pauses[grid.begins] = [part.pause_s - part.folded_s for part in grid.record.parts]
        within = None if scene.angle_rad is None else self._scene_within()
        return replace(scene, fitted=self.fitted, pauses_s=pauses, states=self.states, within=within)

    @cached_property
    def present(self) -> np.ndarray:
        """Share of each interval in which a pulse acts, late pulses at their true time, shape (K,)."""
        return np.minimum(self.grid.interval_means(self.scene.acting), 1.0)

    @cached_property
    def _middle(self) -> np.ndarray:
        """Mean place of the samples within each interval, 0 to 1, shape (K,)."""
        grid = self.grid
        mean = np.bincount(grid.interval, grid.fraction, minlength=grid.size) / np.maximum(grid.count, 1)
        return np.where(grid.count > 0, mean, 0.5)

    def _scene_within(self) -> Scene:
        """At `WITHIN` places of each interval, evenly about the middle of its samples, shape (WITHIN K,)."""
        grid = self.grid
        about = (np.arange(WITHIN) + 0.5) / WITHIN - 0.5
        time_s = (np.arange(grid.size) + self._middle)[:, None] + about
        widths_us = np.repeat(grid.pulse_width_us, WITHIN)
        return self._scene(time_s.ravel() * grid.step_s, widths_us, WITHIN * grid.begins)

    @cached_property
    def scene_at_ends(self) -> Scene:
        """At the ends of the intervals, shape (K + 1,)."""
        grid = self.grid
        widths_us = np.r_[grid.pulse_width_us, grid.pulse_width_us[-1]]
        scene = self._scene(np.arange(grid.size + 1) * grid.step_s, widths_us, grid.begins)
        return replace(scene, pauses_s=np.r_[self.scene.rest_s, 0.0])

    @cached_property
    def scene_at_samples(self) -> Scene:
        """At the record's samples, shape (N,)."""
        grid = self.grid
        time_s = (grid.interval + grid.fraction) * grid.step_s
        first = np.array([part.first for part in grid.record.parts])
        return self._scene(time_s, grid.pulse_width_us[grid.interval], first)

    def _scene(self, time_s: np.ndarray, width_us: np.ndarray, first: np.ndarray) -> Scene:
        grid = self.grid
        return Scene(
            time_s=time_s,
            pulse_width_us=width_us,
            step_s=grid.step_s,
            scale_nm=self.scale_nm,
            largest_us=self.basis.largest_us,
            **self._motion_at(time_s + grid.start_s),
            reference_rad=self.reference_rad,
            angle_range_rad=self.angle_range_rad,
            begins=np.isin(np.arange(time_s.size), first),
            noise_sd_nm=self.noise_sd_nm,
            zero_nm=self.zero_nm,
            reference_s=self.reference_s,
        )

    def _motion_at(self, time_s: np.ndarray) -> dict[str, Any]:
        """Angle, velocity and acceleration of the joint at times of the record, as far as they are known."""
        record = self.grid.record
        motion = self.motion or record.motion or record
        first = np.array([part.first for part in record.parts])
        starts_s, ends_s = record.time_s[first], record.time_s[np.r_[first[1:], record.time_s.size] - 1]
        part = np.maximum(np.searchsorted(starts_s, time_s, side="right") - 1, 0)
        # What was read at a time had been so before; a delay leads out of no part.
        read_s = np.clip(time_s + self.angle_late_s, starts_s[part], ends_s[part])
        known = {name: getattr(motion, name, None) for name in MOTION}
        return {name: np.interp(read_s, record.time_s, column) for name, column in known.items() if column is not None}

    @cached_property
    def design(self) -> np.ndarray:
        """Spline basis at the recorded widths, shape (n, K)."""
        widths_us, place = self.grid.widths_us
        return np.ascontiguousarray(self.basis.design(widths_us)[place].T)

    @cached_property
    def table(self) -> np.ndarray:
        """Spline basis at `TABLE` even widths up to `REACH` times the largest, shape (n, TABLE)."""
        return np.ascontiguousarray(extended(self.basis, np.linspace(0.0, REACH, TABLE) * self.basis.largest_us).T)

    @cached_property
    def penalty(self) -> np.ndarray:
        """Prior precision of the coefficients, shape (n, n)."""
        # A coefficient of a spline is a torque of plausible size; powers of the width cancel each other and may be
        # large.
        ridge = (1.0 if np.any(self.roughness) else 1e-6) / (3.0 * self.scale_nm) ** 2
        return self.roughness + ridge * np.eye(self.basis.size)

    def to_muscle(self, torque_nm: np.ndarray) -> np.ndarray:
        """From the record's torque to the muscle's: relative to its zero, positive in the direction of pull, N·m."""
        return self.sign * (torque_nm - self.zero_nm)

    def to_record(self, torque_nm: np.ndarray) -> np.ndarray:
        """The inverse of `to_muscle`."""
        return self.zero_nm + self.sign * torque_nm

    def with_(self, **changes: object) -> Setup:
        """The set-up with some fields changed; derived arrays that do not depend on them are kept."""
        changed = replace(self, **changes)  # type: ignore
        if set(changes) <= set(_STALE) and changed.basis.largest_us == self.basis.largest_us:
            own, stale = {*self.__dataclass_fields__}, set().union(*(_STALE[name] for name in changes))
            changed.__dict__.update({n: v for n, v in self.__dict__.items() if n not in own and n not in stale})
        return changed

    def without_penalty(self, basis: Basis) -> Setup:
        """The set-up with another basis of the curve, and no penalty on its coefficients."""
        return self.with_(basis=basis, roughness=0.0)


_STALE = {
    "roughness": {"penalty"},
    "curve_nm": set(),
    "basis": {"penalty", "design", "table"},
    "fitted": {"stretches", "scene"},
}
"""Derived arrays of a `Setup` that depend on a field; on fields that are not listed they may all depend."""

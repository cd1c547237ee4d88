"""From a record to the fit of the plain structure, with the set-up that all candidates share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stimrig.identify.dynamics.make_grid import make_grid
from stimrig.identify.dynamics.pulse_grid import Grid
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.joint import Fitted, solve
from stimrig.identify.estimation.pilot import estimate
from stimrig.identify.estimation.projection import Solution
from stimrig.identify.estimation.rows import joint_of, refuse_few, still_rows
from stimrig.identify.estimation.samples import Raw, inspect, white_noise
from stimrig.identify.noise.level import NoiseLevel
from stimrig.identify.records.record import Record
from stimrig.identify.simulation.problem import Problem
from stimrig.identify.simulation.setup import Setup

LEAST_SPREAD = 0.2
"""The noise of a part is taken as at least this share of the largest one."""
NEGLIGIBLE_LAG_S, QUICK_S = 1e-3, 3e-3
"""A second lag below the first value hardly changes the torque, and a search stops there: it is restarted at
QUICK_S."""


def block_means(grid: Grid, torque_nm: np.ndarray) -> np.ndarray:
    """Means over pulse intervals, N·m; NaN where there is no sample."""
    total = np.bincount(grid.interval, torque_nm, minlength=grid.size) / np.maximum(grid.count, 1)
    return np.where(grid.count > 0, total, np.nan)


def prepare(record: Record) -> tuple[Grid, Raw]:
    """Put a record on its grid, without hum and with its white noise; and what its samples show.

    Raises
    ------
    BadRecord, NotIdentifiable
        No grid can be made, too few rows may be fitted, there is no pulse, or the torque never changes.
    """
    grid = make_grid(record)
    refuse_few(grid.fitted)
    if not np.max(grid.pulse_width_us[grid.fitted]) > 0:
        raise NotIdentifiable("the record has no pulse", fix="Record a PRBS and a ramp.")
    if not np.ptp(grid.torque_nm[grid.fitted]) > 0:
        raise NotIdentifiable("the torque never changes", fix="Check the load cell and the electrodes.")
    raw = inspect(record, grid.start_s)
    return replace(grid, torque_nm=block_means(grid, raw.torque_nm), noise_sd_nm=raw.noise_sd_nm), raw


def fit_plain(grid: Grid, rows: np.ndarray) -> Fitted:
    """Fit the plain structure. Its set-up is shared by all candidates of the record.

    Knots and smoothness of the recruitment curve are chosen here. They are not changed while effects are tried; once
    that is over, those of a joint that moves may be chosen again (`renewed_curve`).
    """
    return to_fitted(estimate(grid, still_rows(grid, rows))[0], rows)


def to_fitted(solution: Solution, rows: np.ndarray, most: int = 20) -> Fitted:
    """The solution of the joint problem on some rows, with white and slow noise, started from a projected solution.

    The projected solution may be of fewer rows, where the joint moves in the others: see `still_rows`.
    """
    solution = _with_zeros(solution, rows)
    setup = setup_of(solution, rows)
    problem = Problem(setup, [])
    size, linear = solution.projection.basis.size, solution.linear
    values = np.zeros(problem.size)
    values[:3] = linear.time_constant_s, linear.damping, linear.delay_s
    parts = setup.grid.begins.size
    values[list(problem.baselines)] = setup.to_muscle(solution.coefficients[size : size + parts])
    values[list(problem.initials)] = setup.sign * solution.coefficients[size + parts :]
    values[problem.coefficients] = setup.sign * solution.coefficients[:size]
    noise = NoiseLevel(max(solution.ar1, 0.0), 0.5, float(np.sqrt(solution.variance)))
    fitted = solve(problem, problem.from_physical(values), noise, most=most)
    values = fitted.physical
    quick_s, slow_s = 0.5 * values[0] / values[1], 2.0 * values[0] * values[1]
    if not most or quick_s > NEGLIGIBLE_LAG_S:
        return fitted
    values[0] = np.sqrt(QUICK_S * slow_s)
    values[1:3] = 0.5 * (QUICK_S + slow_s) / values[0], 0.0
    theta = np.clip(problem.from_physical(values), problem.lower, problem.upper)
    return max(fitted, solve(problem, theta, noise, most=most), key=lambda found: found.log_evidence)


def _with_zeros(solution: Solution, rows: np.ndarray) -> Solution:
    """The solution with a zero for parts of which it has no row: the middle of their torque without pulses."""
    projection, grid = solution.projection, solution.projection.grid
    found = solution.coefficients.copy()
    for part in range(grid.begins.size):
        own = rows & (grid.part == part)
        if own.any() and not np.any(projection.rows & own):
            rest = own & (grid.pulse_width_us == 0)
            found[projection.basis.size + part] = np.median(grid.torque_nm[rest if rest.any() else own])
    return replace(solution, coefficients=found)


def setup_of(solution: Solution, rows: np.ndarray) -> Setup:
    """The set-up that all candidates share, from the projected solution and the rows that are fitted."""
    projection, grid = solution.projection, solution.projection.grid
    size = projection.basis.size
    curve = projection.basis.design(np.linspace(0.0, projection.basis.largest_us, 101)) @ solution.coefficients[:size]
    sign = 1.0 if curve[np.argmax(np.abs(curve))] >= 0 else -1.0
    zero = float(solution.coefficients[size])
    target = sign * (grid.torque_nm - zero)
    parts = grid.begins.size
    own_zero = sign * (solution.coefficients[size : size + parts][grid.part] - zero)
    smooth = np.convolve(np.where(rows, target - own_zero, 0.0), np.ones(3) / 3, "same")
    scale = float(np.percentile(np.abs(smooth[rows]), 99.5))
    return Setup(
        grid=grid,
        target_nm=target,
        fitted=rows,
        basis=projection.basis,
        roughness=solution.weight / max(solution.variance, 1e-300) * projection.roughness,
        scale_nm=max(scale, 1e-9),
        noise_sd_nm=grid.noise_sd_nm,
        delay_bounds_s=grid.delay_bounds_s if projection.delay_s is None else (projection.delay_s, projection.delay_s),
        zero_nm=zero,
        sign=sign,
        spread=_spread(grid),
        reference_s=_reference(grid, rows),
        **joint_of(grid, rows),
    )


def _spread(grid: Grid) -> np.ndarray | float:
    """Noise of each interval, divided by the mean noise: each part of a record has its own noise."""
    parts = grid.begins.size
    if parts == 1:
        return 1.0
    record = grid.record
    kept = grid.counted & ~record.held_out
    parts_sd = [_part_noise(record, record.torque_nm[kept & (record.part == part)]) for part in range(parts)]
    own = np.array(parts_sd)
    known = own[np.isfinite(own)]
    if not known.size:
        return 1.0
    own = np.where(np.isfinite(own), own, known.mean())
    # Even a very quiet part does not get an unlimited weight.
    own = np.maximum(own, LEAST_SPREAD * own.max())
    return (own / own.mean())[grid.part]


def _part_noise(record: Record, torque_nm: np.ndarray) -> float:
    """White noise of a sample of one part, at least that of its quantisation, N·m; NaN with fewer than 16 samples."""
    if torque_nm.size < 16:
        return float("nan")
    step = np.abs(np.diff(torque_nm))
    count = float(np.min(step[step > 0], initial=np.inf))
    return max(white_noise(record, torque_nm), count / np.sqrt(12.0) if np.isfinite(count) else 0.0)


def _reference(grid: Grid, rows: np.ndarray) -> float:
    """Mean time of the fitted pulses below the largest width, s; of all pulses if there is none."""
    width = grid.pulse_width_us
    partly = rows & (width > 0) & (width < 0.97 * width.max())
    at = np.flatnonzero(partly if partly.any() else rows & (width > 0))
    return float(np.mean(at) * grid.step_s) if at.size else 0.0

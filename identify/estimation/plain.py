"""From a grid to the fit of the plain structure: a pilot with few knots, the final spline.

Of a moving joint, the rows at one angle are fitted to begin with; the curve is chosen again with all rows once effects
of the joint are there. The set-up is shared by all candidates."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.candidates import chosen
from stimrig.identify.estimation.joint import Fitted, gram, knows_joint, solve
from stimrig.identify.estimation.projection import (
    Projection,
    Solution,
    ar1_or_white,
    bounded,
    curve_points,
    descend_from,
    search,
)
from stimrig.identify.estimation.rests import rest_levels
from stimrig.identify.estimation.samples import white_noise
from stimrig.identify.noise import WHITE, NoiseLevel
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment.bases import SplineBasis
from stimrig.identify.recruitment.smoothing import (
    KNOTS,
    PILOT_KNOTS,
    QUIET_KNOTS,
    bending_order,
    choose_weight,
    fitting_spline,
    knots_for,
    spline_roughness,
)
from stimrig.identify.simulation.problem import Problem
from stimrig.identify.simulation.setup import Setup

STILL_RAD_S = 0.05
"""A joint that moves more slowly is held still."""
ONE_ANGLE_RAD = 0.09
"""Angles that differ from the middle by less are one: 5 degrees, within which the active torque hardly changes."""
LEAST_S = 3.0
"""Stimulation at one angle from which a first curve can be found there."""
LEAST_WIDTHS = 5
WIDEST_SHARE = 0.9
"""The widest pulse at this angle is at least this share of the widest one anywhere."""


def still_rows(grid: Grid, rows: np.ndarray) -> np.ndarray:
    """Select the rows in which the joint is held at the angle with most stimulation, shape (K,).

    Where the joint never moved, where there is no angle, or where too little was stimulated at any one angle: all.
    """
    if grid.angle_rad is None or grid.velocity_rad_s is None or not moves(grid, rows):
        return rows
    at_one_angle = np.zeros(grid.size, bool)
    still = rows & (np.abs(grid.velocity_rad_s) < STILL_RAD_S)
    if still.any():
        at_one_angle = still & (
            np.abs(grid.angle_rad - _middle(grid.angle_rad, still, grid.pulse_width_us)) < ONE_ANGLE_RAD
        )
    widths_us = grid.pulse_width_us[at_one_angle & (grid.pulse_width_us > 0)]
    enough = (
        widths_us.size * grid.step_s >= LEAST_S
        and np.unique(widths_us).size >= LEAST_WIDTHS
        and widths_us.max() >= WIDEST_SHARE * grid.pulse_width_us[rows].max()
    )
    return at_one_angle if enough else rows


def moves(grid: Grid, rows: np.ndarray) -> bool:
    """Return True if the joint is at more than one angle in the given rows."""
    return grid.angle_rad is not None and bool(np.ptp(grid.angle_rad[rows]) > 2 * ONE_ANGLE_RAD)


def joint_of(grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    """Fields of a `Setup`: the reference angle, and the range of the fitted angles; none without an angle.

    The reference is the angle at which most was stimulated while the joint was still, else the median while stimulated:
    it does not depend on where the record begins.
    """
    if grid.angle_rad is None or grid.velocity_rad_s is None:
        return {}
    still = rows & (np.abs(grid.velocity_rad_s) < STILL_RAD_S) & (grid.pulse_width_us > 0)
    stimulated = rows & (grid.pulse_width_us > 0)
    if still.any():
        reference = _middle(grid.angle_rad, still, grid.pulse_width_us)
    else:
        reference = float(np.median(grid.angle_rad[stimulated if stimulated.any() else rows]))
    return {
        "reference_rad": reference,
        "angle_range_rad": (float(grid.angle_rad[rows].min()), float(grid.angle_rad[rows].max())),
    }


def _middle(angle_rad: np.ndarray, still: np.ndarray, width_us: np.ndarray) -> float:
    """The angle around which most stimulated rows lie, rad: the median of those in the fullest window."""
    at = np.sort(angle_rad[still & (width_us > 0)])
    if not at.size:
        at = np.sort(angle_rad[still])
    ends = np.searchsorted(at, at + 2 * ONE_ANGLE_RAD, side="right")
    first = int(np.argmax(ends - np.arange(at.size)))
    return float(np.median(at[first : ends[first]]))


STARTS_S = (0.12, 0.4)
ROUNDING = 2e-5
"""Share of the torque's range below which a residual is not noise."""
QUIET = 0.0015
"""If the noise of a sample is below this share of the torque's range, the spline gets more knots: its error at a bend
would be visible."""

SUDDEN, SUDDEN_SHARE = 150.0, 0.003
"""If what slow noise cannot foresee of a pilot's residual is so many times the noise, and this share of the torque's
range, the torque jumps by itself."""


def pilot_solution(grid: Grid, rows: np.ndarray, delay_s: float | None = None) -> Solution:
    """A first fit with few knots, from the best of several starting values of the time constant.

    Raises NotIdentifiable: the pulse width or the torque never changes.
    """
    widths_us = grid.pulse_width_us[rows]
    if np.ptp(widths_us) <= 0:
        raise NotIdentifiable("the pulse width never changes in the fitted pulses", fix="Record a PRBS and a ramp.")
    if np.ptp(grid.torque_nm[rows]) <= 0:
        raise NotIdentifiable("the torque never changes", fix="Check the load cell and the electrodes.")
    basis = SplineBasis(np.linspace(0.0, float(np.max(grid.pulse_width_us)), PILOT_KNOTS))
    projection = Projection(grid, basis, spline_roughness(basis, order=bending_order(widths_us)), rows, delay_s)
    delay = 0.0 if delay_s is None else delay_s
    starts = [Solution(projection, bounded(projection, SecondOrder(t, 0.9, delay))) for t in STARTS_S]
    best = min(starts, key=lambda start: start.cost)
    return descend_from(best, max_steps=12, tolerance=0.5)


def designed(first: Solution, count: int | None = None) -> tuple[Projection, SecondOrder]:
    """The projection with its final spline, and the start of its search, from a pilot.

    The few knots of the pilot show roughly where the curve bends. A curve with all knots shows place and size of the
    bend better; repeating this once improves a steep rise.
    """
    old, largest_us = first.projection, float(np.max(first.projection.grid.pulse_width_us))
    widths_us = old.grid.pulse_width_us[old.rows]
    count = knots_for(first.curve) if count is None else count
    basis, roughness = fitting_spline(first.curve, largest_us, count, widths_us)
    for _ in range(2):
        projection = replace(old, basis=basis, roughness=roughness)
        drawn_curve = basis, Solution(projection, first.linear, variance=first.variance).above_rest[: basis.size]
        basis, roughness = fitting_spline(curve_points(*drawn_curve), largest_us, count, widths_us, drawn_curve)
    return replace(old, basis=basis, roughness=roughness), first.linear


def _is_quiet(first: Solution) -> bool:
    """Return True if the noise is so small that few knots would show, and no jumps (as of an arm) limit the fit."""
    noise_nm = first.projection.grid.noise_sd_nm
    if not 0.0 < noise_nm < QUIET * first.projection.range_nm:
        return False
    ar1 = ar1_or_white(first.residual_nm, first.projection.stretches)[0]
    sudden_nm = np.sqrt(first.whitened_variance(ar1))
    return bool(sudden_nm < max(SUDDEN * noise_nm, SUDDEN_SHARE * first.projection.range_nm))


def estimate(
    grid: Grid, rows: np.ndarray, knots: int | None = None, delay_s: float | None = None, white: bool = False
) -> tuple[Solution, float]:
    """The solution, and the evidence for AR(1) over white noise (ΔBIC); `white`: the noise is white, all the same."""
    first = pilot_solution(grid, rows, delay_s)
    projection, start = designed(first, QUIET_KNOTS if knots is None and _is_quiet(first) else knots)
    solution = search(projection, start, variance=first.variance)
    ar1, delta_bic = ar1_or_white(solution.residual_nm, projection.stretches)
    if delta_bic > 0 and knots is None and projection.basis.size < KNOTS:
        # The correlation may come from a bend that few knots cannot follow: first try all knots.
        projection, start = designed(first, KNOTS)
        solution = search(projection, start, variance=first.variance)
        ar1, delta_bic = ar1_or_white(solution.residual_nm, projection.stretches)
    # Without noise the residual is rounding and the spline's own error, which need no noise model.
    still = solution.variance < (ROUNDING * float(np.ptp(projection.target[rows]))) ** 2
    for _ in range(0 if still or white else 3):
        if delta_bic <= 0:
            break
        solution = search(projection, solution.linear, ar1=ar1, variance=solution.whitened_variance(ar1))
        before = ar1
        ar1, delta_bic = ar1_or_white(solution.residual_nm, projection.stretches)
        if abs(ar1 - before) < 0.01:
            break
    return solution, delta_bic


LEAST_SPREAD = 0.2
"""The noise of a part is taken as at least this share of the largest one."""
NEGLIGIBLE_LAG_S, QUICK_S = 1e-3, 3e-3
"""A second lag below the first value hardly changes the torque, and a search stops there: it is restarted at
QUICK_S."""


def fit_plain(grid: Grid, rows: np.ndarray) -> Fitted:
    """Fit the plain structure. Its set-up is shared by all candidates of the record.

    Knots and smoothness of the recruitment curve are chosen here. They are not changed while effects are tried; once
    that is over, those of a joint that moves may be chosen again (`renewed_curve`).
    """

    def fit(selected: np.ndarray, white: bool) -> Fitted:
        return to_fitted(estimate(grid, still_rows(grid, selected), white=white)[0], selected, white=white)

    return chosen(grid, rows, fit(rows, False), fit)


def to_fitted(
    solution: Solution,
    rows: np.ndarray,
    max_steps: int = 20,
    white: bool = False,
    coefficients: np.ndarray | None = None,
) -> Fitted:
    """The solution of the joint problem on some rows, with white and slow noise, started from a projected solution.

    The projected solution may be of fewer rows, where the joint moves in the others: see `still_rows`. `white`: the
    noise is held white. `coefficients`: in place of the solution's own.
    """
    filled = _fill_zeros(solution.projection, solution.coefficients if coefficients is None else coefficients, rows)
    setup = _setup_of(solution, filled, rows)
    problem = Problem(setup, [])
    size, linear = solution.projection.basis.size, solution.linear
    values = np.zeros(problem.size)
    values[:3] = linear.time_constant_s, linear.damping, linear.delay_s
    parts = setup.grid.begins.size
    values[list(problem.baselines)] = setup.to_muscle(filled[size : size + parts])
    values[list(problem.initials)] = setup.sign * filled[size + parts :]
    values[problem.coefficients] = setup.sign * filled[:size]
    noise = WHITE if white else NoiseLevel(max(solution.ar1, 0.0), 0.5, float(np.sqrt(solution.variance)))
    fitted = solve(problem, problem.from_physical(values), noise, max_steps=max_steps)
    values = fitted.physical
    quick_s, slow_s = 0.5 * values[0] / values[1], 2.0 * values[0] * values[1]
    if not max_steps or quick_s > NEGLIGIBLE_LAG_S:
        return fitted
    values[0] = np.sqrt(QUICK_S * slow_s)
    values[1:3] = 0.5 * (QUICK_S + slow_s) / values[0], 0.0
    theta = np.clip(problem.from_physical(values), problem.lower, problem.upper)
    return max(fitted, solve(problem, theta, noise, max_steps=max_steps), key=lambda candidate: candidate.log_evidence)


def _fill_zeros(projection: Projection, coefficients: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The coefficients with a zero for parts of which there is no row: the middle of their torque without pulses."""
    grid, filled = projection.grid, coefficients.copy()
    for part in range(grid.begins.size):
        part_rows = rows & (grid.part == part)
        if part_rows.any() and not np.any(projection.rows & part_rows):
            rest = part_rows & (grid.pulse_width_us == 0)
            filled[projection.basis.size + part] = np.median(grid.torque_nm[rest if rest.any() else part_rows])
    return filled


def _setup_of(solution: Solution, coefficients: np.ndarray, rows: np.ndarray) -> Setup:
    """The set-up that all candidates share, from the projected solution and the rows that are fitted."""
    projection, grid = solution.projection, solution.projection.grid
    size = projection.basis.size
    curve = projection.basis.design(np.linspace(0.0, projection.basis.largest_us, 101)) @ coefficients[:size]
    sign = 1.0 if curve[np.argmax(np.abs(curve))] >= 0 else -1.0
    zero = float(coefficients[size])
    target = sign * (grid.torque_nm - zero)
    parts = grid.begins.size
    own_zero = sign * (coefficients[size : size + parts][grid.part] - zero)
    smooth = np.convolve(np.where(rows, target - own_zero, 0.0), np.ones(3) / 3, "same")
    scale = float(np.percentile(np.abs(smooth[rows]), 99.5))
    level_nm, sd_nm = projection.rests if rows is projection.rows else rest_levels(grid, rows)
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
        rests_nm=(sign * (level_nm - zero), sd_nm),
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
    usable = grid.counted & ~record.held_out
    parts_sd = [_part_noise(record, usable & (record.part == part)) for part in range(parts)]
    sd = np.array(parts_sd)
    known = sd[np.isfinite(sd)]
    if not known.size:
        return 1.0
    sd = np.where(np.isfinite(sd), sd, known.mean())
    # Even a very quiet part does not get an unlimited weight.
    sd = np.maximum(sd, LEAST_SPREAD * sd.max())
    return (sd / sd.mean())[grid.part]


def _part_noise(record: Record, rows: np.ndarray) -> float:
    """White noise of a sample of one part, at least that of its quantisation, N·m; NaN with fewer than 16 samples."""
    if rows.sum() < 16:
        return float("nan")
    step = np.abs(np.diff(record.torque_nm[rows]))
    count = float(np.min(step[step > 0], initial=np.inf))
    noise = white_noise(record, rows, record.torque_nm)[0]
    return max(noise, count / np.sqrt(12.0) if np.isfinite(count) else 0.0)


def _reference(grid: Grid, rows: np.ndarray) -> float:
    """Mean time of the fitted pulses below the largest width, s; of all pulses if there is none."""
    width = grid.pulse_width_us
    partly = rows & (width > 0) & (width < 0.97 * width.max())
    at = np.flatnonzero(partly if partly.any() else rows & (width > 0))
    return float(np.mean(at) * grid.step_s) if at.size else 0.0


TIMES = 2
"""The first curve shows roughly where the knots belong, the second one better."""
RENEWED_POINTS = 1001


def renewed_curve(base: Fitted) -> Fitted:
    """The model with the knots and the smoothness of its curve chosen with all rows, where the evidence rises by that.

    The plain structure is fitted where the joint is held still (`still_rows`), since elsewhere it lacks g and h; its
    curve is as smooth as those rows alone ask for. Once g and h are there, the other rows show f, too. The model is
    returned as it is if its curve was chosen with all rows already (also where the joint was nowhere still for long
    enough), if no effect of it depends on the joint, or if its curve is no smoothed spline.
    """
    if not _can_be_renewed(base):
        return base
    with suppress(np.linalg.LinAlgError):  # then the curve as it is remains the best one known
        for _ in range(TIMES):
            renewed = _renewed(base)
            if not renewed.log_evidence > base.log_evidence or (base.converged and not renewed.converged):
                break
            base = renewed
    return base


def _can_be_renewed(base: Fitted) -> bool:
    setup = base.problem.setup
    smoothed = isinstance(setup.basis, SplineBasis) and np.any(setup.roughness) and not np.any(setup.curve_nm)
    return bool(smoothed and knows_joint(base) and not np.all(still_rows(setup.grid, setup.fitted)[setup.fitted]))


def _renewed(base: Fitted) -> Fitted:
    """The model with more knots, where its present curve bends, and with the smoothness that all rows ask for."""
    setup, values = base.problem.setup, base.physical
    old, place = setup.basis, base.problem.coefficients
    assert isinstance(old, SplineBasis)
    curve_nm = values[place]
    u = np.linspace(0.0, old.largest_us, RENEWED_POINTS)
    torque_nm = old.design(u) @ curve_nm
    widths_us, curve = setup.grid.pulse_width_us[setup.fitted], (u[::5], torque_nm[::5])
    basis, roughness = fitting_spline(curve, old.largest_us, QUIET_KNOTS, widths_us, (old, curve_nm))
    start_nm = np.linalg.lstsq(basis.design(u), torque_nm, rcond=None)[0]
    rough = Problem(setup.with_(basis=basis, roughness=roughness), base.effects)
    theta = rough.from_physical(np.concatenate([values[: place.start], start_nm, values[place.stop :]]))
    precision = _precision(rough, theta, base, roughness)
    return solve(Problem(setup.with_(basis=basis, roughness=precision), base.effects), theta, base.noise)


def _precision(problem: Problem, theta: np.ndarray, base: Fitted, roughness: np.ndarray) -> np.ndarray:
    """The prior precision of the curve's coefficients, by REML at a point; all else is linear there, too."""
    setup, place = problem.setup, problem.coefficients
    mean, slopes = problem.run(theta, derivatives=True)
    assert slopes is not None
    curve = np.arange(place.start, place.stop)
    others = np.delete(np.arange(problem.size), curve)
    # what the curve and the others' changes have to explain: the residual, and the curve itself
    target = setup.target_nm - mean + theta[place] @ slopes[place]
    products = gram(setup.whitened(np.vstack([target, slopes[curve], slopes[others]]), base.noise))
    inner = 1 + curve.size
    bound = products[inner:, inner:] + problem.prior[1][np.ix_(others, others)]
    projected = products[:inner, :inner] - products[:inner, inner:] @ np.linalg.solve(bound, products[inner:, :inner])
    design, moment = ((projected + projected.T) / 2)[1:, 1:].copy(), projected[1:, 0].copy()
    chosen = choose_weight(design, moment, float(projected[0, 0]), int(setup.fitted.sum()), roughness, others.size)
    return chosen.weight / chosen.variance * roughness

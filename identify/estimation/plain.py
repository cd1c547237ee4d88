"""From a grid to the fit of the plain structure: a pilot with few knots shows where the final spline needs its own.

Both are the same problem, and `solve` finds both. Of a moving joint, the rows at one angle are fitted to begin with;
the curve is chosen again with all rows once effects of the joint are there. The set-up is shared by all candidates."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.candidates import chosen
from stimrig.identify.estimation.rests import rest_levels
from stimrig.identify.estimation.samples import white_noise
from stimrig.identify.estimation.solve import Fitted, gram, knows_joint, linear_start, solve, solve_scaled
from stimrig.identify.estimation.still import joint_of, still_rows
from stimrig.identify.noise import WHITE, WHITE_AND_SLOW, NoiseLevel
from stimrig.identify.problem.problem import Problem
from stimrig.identify.problem.setup import Setup
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment import Basis, Curve, smoothing
from stimrig.identify.recruitment.bases import SplineBasis

STARTS_S = (0.12, 0.4)
USUAL_NOISE = 0.02
"""Noise of an interval's mean, as a share of the largest torque, before anything is fitted."""
PILOT_TOLERANCE = 0.1
"""A pilot ends when the log posterior rises by less: it is a start."""
REWEIGHTED, SETTLED = 3, 0.1
"""The smoothness is chosen anew at the solution, so many times at most, until its logarithm changes by less."""
STIFFEST = 1e12
"""Largest precision of a curve's bending, for a curve of size 1: rounding leaves no prior of a stiffer one."""
NO_NOISE = 1e-14
"""Variance, as a share of the usual one, below which it is that of rounding."""
CURVE_POINTS = 201
QUIET = 0.0015
"""If the noise of a sample is below this share of the largest torque, the spline gets more knots: its error at a bend
would be visible."""
SUDDEN, SUDDEN_SHARE = 150.0, 0.003
"""If what the interval before cannot foresee of a pilot's residual is so many times the noise, and this share of the
largest torque, the torque jumps by itself."""
LEAST_SPREAD = 0.2
"""The noise of a part is taken as at least this share of the largest one."""
NEGLIGIBLE_LAG_S, QUICK_S = 1e-3, 3e-3
"""A second lag below the first value hardly changes the torque, and a search stops there: it is restarted at
QUICK_S."""


def fit_plain(grid: Grid, rows: np.ndarray, knots: int | None = None, delay_s: float | None = None) -> Fitted:
    """Fit the plain structure to some rows. Its set-up is shared by all candidates of the record.

    Knots and smoothness of the recruitment curve are chosen here. They are not changed while effects are tried; once
    that is over, those of a joint that moves may be chosen again (`renewed_curve`).

    `knots`: number of knots of the curve, if it is given; `delay_s`: a delay that is known.
    """

    def fit(selected: np.ndarray, white: bool) -> Fitted:
        return fit_spline(grid, selected, knots, delay_s, WHITE if white else WHITE_AND_SLOW)

    return chosen(grid, rows, fit(rows, False), fit)


def fit_spline(
    grid: Grid,
    rows: np.ndarray,
    knots: int | None = None,
    delay_s: float | None = None,
    noise: NoiseLevel = WHITE_AND_SLOW,
) -> Fitted:
    """The plain structure on all given rows, with a noise of the kind of `noise`."""
    still = still_rows(grid, rows)
    first = pilot(grid, still, delay_s)
    count = knots or (smoothing.QUIET_KNOTS if _is_quiet(first) else smoothing.knots_for(_points(first.curve)))
    fitted = _with_knots(first, count, noise)
    if knots is None and count < smoothing.KNOTS and not fitted.noise.is_white:
        # The correlation may come from a bend that few knots cannot follow.
        fitted = _with_knots(first, smoothing.KNOTS, noise)
    if still is not rows:
        fitted = _on_rows(fitted, rows)
    values = fitted.physical
    quick_s, slow_s = 0.5 * values[0] / values[1], 2.0 * values[0] * values[1]
    if quick_s > NEGLIGIBLE_LAG_S:
        return fitted
    values[0] = np.sqrt(QUICK_S * slow_s)
    values[1:3] = 0.5 * (QUICK_S + slow_s) / values[0], 0.0
    other = solve(fitted.problem, fitted.problem.from_physical(values), noise)
    return max(fitted, other, key=lambda candidate: candidate.log_evidence)


def pilot(grid: Grid, rows: np.ndarray, delay_s: float | None = None) -> Fitted:
    """A first fit with few knots and white noise, from the best of several starting values of the time constant.

    Raises NotIdentifiable: the pulse width or the torque never changes.
    """
    widths_us = grid.pulse_width_us[rows]
    if not np.ptp(widths_us) > 0:
        raise NotIdentifiable("the pulse width never changes in the fitted pulses", fix="Record a PRBS and a ramp.")
    if not np.ptp(grid.torque_nm[rows]) > 0:
        raise NotIdentifiable("the torque never changes", fix="Check the load cell and the electrodes.")
    basis = SplineBasis(np.linspace(0.0, float(np.max(grid.pulse_width_us)), smoothing.PILOT_KNOTS))
    roughness = smoothing.spline_roughness(basis, order=smoothing.bending_order(widths_us))
    bounds_s = None if delay_s is None else (delay_s, delay_s)
    return fit_from(plain_setup(grid, rows, basis, bounds_s), STARTS_S, roughness)


def fit_from(setup: Setup, starts_s: tuple[float, ...], roughness: np.ndarray) -> Fitted:
    """The plain structure with white noise, from the best of several starting values of the time constant."""
    starts = [start_at(setup, SecondOrder(t, 0.9, 0.0), roughness) for t in starts_s]
    problem, theta, white = min(starts, key=lambda start: start[2].sd_nm)
    return solve(problem, theta, white, tolerance=PILOT_TOLERANCE)


def start_at(setup: Setup, linear: SecondOrder, roughness: np.ndarray) -> tuple[Problem, np.ndarray, NoiseLevel]:
    """The problem with the smoothness of the curve, its parameters, and the white noise, at given dynamics.

    All but the dynamics is linear: it is solved for. `setup`: of `plain_setup`, without a penalty.
    """
    problem = Problem(setup, [])
    values = np.zeros(problem.size)
    values[:3] = linear.time_constant_s, linear.damping, linear.delay_s
    theta = np.clip(problem.from_physical(values), problem.lower, problem.upper)
    prior_mean, precision = problem.prior
    theta[3:] = prior_mean[3:]
    mean, slopes = problem.run(theta, derivatives=True)
    assert slopes is not None
    noise = NoiseLevel(0.0, 0.0, USUAL_NOISE * setup.scale_nm)
    others = np.arange(problem.baselines.start, problem.coefficients.start)
    curve = np.arange(problem.coefficients.start, problem.coefficients.stop)
    free = np.r_[curve, others]
    products = gram(setup.whitened(np.vstack([setup.target_nm - mean, slopes[free]]), noise))
    smoothness = _smoothness(products, precision[np.ix_(others, others)], roughness, int(setup.fitted.sum()))
    problem = _smoothed(problem, roughness, smoothness)
    part = problem.prior[1][np.ix_(free, free)]
    products = products / smoothness.variance
    theta[free] += solve_scaled(products[1:, 1:] + part, products[0, 1:])
    return problem, theta, replace(WHITE, sd_nm=noise.sd_nm * float(np.sqrt(smoothness.variance)))


def plain_setup(grid: Grid, rows: np.ndarray, basis: Basis, delay_bounds_s: tuple[float, float] | None = None) -> Setup:
    """The set-up of a record whose rests show its zeros and whose torque rises by stimulation, without a penalty.

    `delay_bounds_s`: by default those of the grid.
    """
    level_nm, sd_nm = rest_levels(grid, rows)
    setup = Setup(
        grid=grid,
        target_nm=grid.torque_nm,
        fitted=rows,
        basis=basis,
        scale_nm=1.0,
        noise_sd_nm=grid.noise_sd_nm,
        delay_bounds_s=grid.delay_bounds_s if delay_bounds_s is None else delay_bounds_s,
        rests_nm=(level_nm, sd_nm),
        spread=_spread(grid),
        reference_s=_reference(grid, rows),
        **joint_of(grid, rows),
    )
    return _with_zeros(setup, level_nm, 1.0)


def _with_zeros(setup: Setup, zeros_nm: np.ndarray, sign: float) -> Setup:
    """The set-up with other zeros of its parts, N·m, shape (B,); `sign`: -1 where stimulation lowers the torque."""
    grid, rows, zero = setup.grid, setup.fitted, float(zeros_nm[0])
    assert setup.rests_nm is not None
    level_nm, sd_nm = setup.to_record(setup.rests_nm[0]), setup.rests_nm[1]
    above_rest = np.convolve(np.where(rows, grid.torque_nm - zeros_nm[grid.part], 0.0), np.ones(3) / 3, "same")
    return setup.with_(
        target_nm=sign * (grid.torque_nm - zero),
        scale_nm=max(float(np.percentile(np.abs(above_rest[rows]), 99.5)), 1e-9),
        zero_nm=zero,
        sign=sign,
        rests_nm=(sign * (level_nm - zero), sd_nm),
    )


def _with_knots(first: Fitted, count: int, noise: NoiseLevel) -> Fitted:
    linear, torque_nm = first.linear, _points(first.curve)[1]
    sign = 1.0 if torque_nm[np.argmax(np.abs(torque_nm))] >= 0 else -1.0
    zeros_nm = first.problem.setup.to_record(first.physical[list(first.problem.baselines)])
    setup = _with_zeros(first.problem.setup, zeros_nm, sign)
    basis, roughness = final_spline(setup, linear, first.curve, count)
    problem, theta, _ = start_at(setup.without_penalty(basis), linear, roughness)
    fitted = solve(problem, theta, noise)
    for _ in range(REWEIGHTED):
        smoothed = with_smoothness(fitted, roughness)
        before, after = (np.trace(p.setup.roughness) for p in (fitted.problem, smoothed))
        if abs(np.log(after / before)) < SETTLED:
            break
        fitted = solve(smoothed, fitted.theta, fitted.noise)
    return fitted


def with_smoothness(fitted: Fitted, roughness: np.ndarray) -> Problem:
    """The problem with the smoothness of its curve that the solution asks for; all else is linear there, too."""
    problem, setup, place = fitted.problem, fitted.problem.setup, fitted.problem.coefficients
    others = np.delete(np.arange(problem.size), place)
    # what the curve and the others' changes have to explain: the residual, and the curve itself
    target = fitted.residual_nm + fitted.theta[place] @ fitted.slopes[place]
    rows = np.vstack([target, fitted.slopes[place], fitted.slopes[others]])
    products = gram(setup.whitened(rows, fitted.noise))
    precision = problem.prior[1][np.ix_(others, others)]
    return _smoothed(problem, roughness, _smoothness(products, precision, roughness, int(setup.fitted.sum())))


def _smoothed(problem: Problem, roughness: np.ndarray, choice: smoothing.Choice) -> Problem:
    stiffest = STIFFEST / max(float(np.trace(roughness)) * problem.setup.scale_nm**2, 1e-300)
    weight = min(choice.weight / choice.variance, stiffest)
    return Problem(problem.setup.with_(roughness=weight * roughness), problem.effects)


def _smoothness(products: np.ndarray, precision: np.ndarray, roughness: np.ndarray, rows: int) -> smoothing.Choice:
    """The weight of the roughness that the data ask for (REML), with all parameters but the curve's projected out.

    `products`: of the target, the slopes by the curve's coefficients and those by the others, whitened, `rows` of each;
    `precision`: prior of the others. Its variance is relative to that of the noise they were whitened with.
    """
    inner, others = len(products) - len(precision), len(precision)
    bound = products[inner:, inner:] + precision
    projected = products[:inner, :inner] - products[:inner, inner:] @ np.linalg.solve(bound, products[inner:, :inner])
    design, moment = ((projected + projected.T) / 2)[1:, 1:].copy(), projected[1:, 0].copy()
    if np.any(roughness):
        choice = smoothing.choose_weight(design, moment, float(projected[0, 0]), rows, roughness, others)
        return smoothing.Choice(choice.weight, max(choice.variance, NO_NOISE))
    explained = float(moment @ np.linalg.lstsq(design, moment, rcond=None)[0])
    return smoothing.Choice(0.0, max((float(projected[0, 0]) - explained) / max(rows - inner - others, 1), NO_NOISE))


def _on_rows(fitted: Fitted, rows: np.ndarray) -> Fitted:
    """The fit continued on more rows: of a joint that moves in the others (`still_rows`)."""
    old, values = fitted.problem.setup, fitted.physical
    grid, baselines = old.grid, list(fitted.problem.baselines)
    zeros_nm = old.to_record(values[baselines])
    for part in range(grid.begins.size):
        part_rows = rows & (grid.part == part)
        if part_rows.any() and not np.any(old.fitted & part_rows):
            rest = part_rows & (grid.pulse_width_us == 0)
            zeros_nm[part] = np.median(grid.torque_nm[rest if rest.any() else part_rows])
    setup = _with_zeros(plain_setup(grid, rows, old.basis, old.delay_bounds_s), zeros_nm, old.sign)
    setup = setup.with_(roughness=old.roughness)
    values[baselines] = setup.to_muscle(zeros_nm)
    problem = Problem(setup, [])
    return solve(problem, problem.from_physical(values), fitted.noise)


def final_spline(setup: Setup, linear: SecondOrder, pilot: Curve, count: int) -> tuple[SplineBasis, np.ndarray]:
    """The spline with so many knots, and the penalty on its bending, from a first curve, at given dynamics.

    Few knots show roughly where the curve bends. A curve with all knots shows place and size of the bend better;
    repeating this once improves a steep rise.
    """
    largest_us, widths_us = pilot.basis.largest_us, setup.grid.pulse_width_us[setup.fitted]
    basis, roughness = smoothing.fitting_spline(_points(pilot), largest_us, count, widths_us)
    for _ in range(2):
        setup = setup.without_penalty(basis)
        curve = curve_at(setup, linear, roughness)
        known = basis, curve.coefficients_nm
        basis, roughness = smoothing.fitting_spline(_points(curve), largest_us, count, widths_us, known)
    return basis, roughness


def curve_at(setup: Setup, linear: SecondOrder, roughness: np.ndarray) -> Curve:
    """The recruitment curve that explains the record best at given dynamics, positive as the set-up's target."""
    problem, theta, _ = start_at(setup, linear, roughness)
    return Curve(setup.basis, theta[problem.coefficients])


def _points(curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    u = np.linspace(0.0, curve.basis.largest_us, CURVE_POINTS)
    return u, curve(u)


def _is_quiet(first: Fitted) -> bool:
    """Return True if the noise is so small that few knots would show, and no jumps (as of an arm) limit the fit."""
    setup = first.problem.setup
    if not 0.0 < setup.noise_sd_nm < QUIET * setup.scale_nm:
        return False
    pairs = setup.fitted[1:] & setup.fitted[:-1] & (np.diff(setup.grid.part) == 0)
    before, after = first.residual_nm[:-1][pairs], first.residual_nm[1:][pairs]
    ar1 = float(before @ after) / max(float(before @ before), 1e-300)
    sudden_nm = float(np.sqrt(np.mean((after - ar1 * before) ** 2)))
    return sudden_nm < max(SUDDEN * setup.noise_sd_nm, SUDDEN_SHARE * setup.scale_nm)


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
    setup = base.problem.setup
    smoothed = isinstance(setup.basis, SplineBasis) and np.any(setup.roughness) and not np.any(setup.curve_nm)
    if not (smoothed and knows_joint(base)) or np.all(still_rows(setup.grid, setup.fitted)[setup.fitted]):
        return base
    with suppress(np.linalg.LinAlgError):  # then the curve as it is remains the best one known
        for _ in range(TIMES):
            renewed = _renewed(base)
            if not renewed.log_evidence > base.log_evidence or (base.converged and not renewed.converged):
                break
            base = renewed
    return base


def _renewed(base: Fitted) -> Fitted:
    """The model with more knots, where its present curve bends, and with the smoothness that all rows ask for."""
    setup, values = base.problem.setup, base.physical
    old, place = setup.basis, base.problem.coefficients
    assert isinstance(old, SplineBasis)
    curve_nm = values[place]
    u = np.linspace(0.0, old.largest_us, RENEWED_POINTS)
    torque_nm = old.design(u) @ curve_nm
    curve, widths_us, known = (u[::5], torque_nm[::5]), setup.grid.pulse_width_us[setup.fitted], (old, curve_nm)
    basis, roughness = smoothing.fitting_spline(curve, old.largest_us, smoothing.QUIET_KNOTS, widths_us, known)
    start_nm = np.linalg.lstsq(basis.design(u), torque_nm, rcond=None)[0]
    rough = Problem(setup.with_(basis=basis, roughness=roughness), base.effects)
    theta = rough.from_physical(np.concatenate([values[: place.start], start_nm, values[place.stop :]]))
    start = solve(rough, theta, base.noise, max_steps=0, profiled=False)
    smoothed = with_smoothness(start, roughness)
    # The old curve on the new knots is not smooth: a stiff prior would be far away.
    return solve(smoothed, linear_start(smoothed, theta, base.noise), base.noise)

"""The range in which a model is valid, and its quality: checks, and one verdict."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import Discrete
from stimrig.identify.effects import depend_on_joint
from stimrig.identify.errors import RunsAway
from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.identify.model import Model
from stimrig.identify.problem.joint_surface import JointEffect, Surfaces
from stimrig.identify.problem.predict import refuse_rate
from stimrig.identify.problem.pulses import above_rest
from stimrig.identify.records.readings import flat_top
from stimrig.identify.records.record import Record
from stimrig.identify.yardstick import held_out_pulses

UNDER_CEILING_POINTS = 1.0
LARGEST_DIP = 0.05
LEAST_FIT_PERCENT = 30.0
FILTER_S, FOLLOWS_PERCENT = 1.0, 50.0
"""The torque follows the pulses if a linear filter of this memory, s, reaches such a fit."""
GOOD_GAP, LARGEST_GAP = 2.0, 8.0
"""Percentage points of fit below the ceiling on held-out pulses: above the first something is missing, above the second
too much."""
WITHIN_NOISE = 1.3
"""If the error is at most this many times the noise, it passes as noise, even if the torque hardly changes."""
FITTED_PULSES = "the fitted pulses"
ANGLE_SLACK_RAD, VELOCITY_SLACK_RAD_S = 0.09, 0.1
"""Five degrees, and what a hand that holds still may move."""
LARGEST_MOVE_RAD = math.radians(10)
"""Less is the give of a fixture."""
MOVED_QUANTILES = (0.01, 0.99)
"""Shares of the samples: between these angles the joint moved."""
NEGLIGIBLE = 5e-4
"""Share of the torque's range below which the kind of an error does not matter."""
PROBES, TAME = 60, 4.0
"""A free effect is tried on so many held widths; its torque must stay below so many times the curve's range."""


def valid_for(model: Model, grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    """Torques and rates of the fitted rows; pulse widths from the record's lowest on: below it nothing was seen."""
    widths = grid.pulse_width_us[rows]
    largest = float(np.max(widths))
    table = model.recruitment(np.linspace(0.0, largest, 101))
    return {
        "pulse_width_us": [float(np.min(grid.record.pulse_width_us)), largest],
        "torque_nm": [float(min(table.min(), 0.0)), float(max(table.max(), 0.0))],
        "measured_torque_nm": [float(np.min(grid.torque_nm[rows])), float(np.max(grid.torque_nm[rows]))],
        "pulse_rate_hz": [model.pulse_rate_hz * 0.95, model.pulse_rate_hz * 1.05],
        "sample_rate_hz": [39.0, 2100.0],
        "memory_s": model.linear.memory_s,
        **_joint(grid, rows),
    }


def _joint(grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    """Angles, rad, and velocities, rad/s, of the fitted rows, where the record has them."""
    columns = {"angle_rad": grid.angle_rad, "velocity_rad_s": grid.velocity_rad_s}
    return {
        name: [float(np.min(column[rows])), float(np.max(column[rows]))]
        for name, column in columns.items()
        if column is not None
    }


def range_warnings(model: Model, record: Record) -> list[str]:
    """Warnings if a record is outside the model's range of validity; otherwise empty.

    Raises BadModel: the pulse rate differs too much: recruitment and dynamics both change with it.
    """
    refuse_rate(model, record)
    warnings = []
    low, high = model.valid_for.get("pulse_rate_hz", (0.0, np.inf))
    if not low <= record.pulse_rate_hz <= high:
        used = f"fitted at {model.pulse_rate_hz:g} pulses/s, but used at {record.pulse_rate_hz:g} pulses/s"
        warnings.append(f"{used}: fit a model at that rate")
    largest = model.valid_for.get("pulse_width_us", (0.0, np.inf))[1]
    beyond = record.pulse_width_us > largest * (1 + 1e-6)
    if np.any(beyond):
        share = f"{100 * float(np.mean(beyond)):.0f} % of the pulse widths"
        above = f"above the largest fitted width, {largest:g} µs"
        warnings.append(f"{share} are {above}: the recruitment curve is constant there")
    return warnings + _joint_warnings(model, record)


def _joint_warnings(model: Model, record: Record) -> list[str]:
    """Warnings if the joint was where, or moved as, it did not in the fitted rows."""
    warnings, motion = [], record.motion
    for column, slack, name, unit in (
        (record.angle_rad, ANGLE_SLACK_RAD, "angle", "rad"),
        (record.velocity_rad_s if motion is None else motion.velocity_rad_s, VELOCITY_SLACK_RAD_S, "velocity", "rad/s"),
    ):
        span = model.valid_for.get(f"{name}_{unit.replace('/', '_')}")
        if column is None or span is None:
            continue
        outside = float(np.mean(~((column >= span[0] - slack) & (column <= span[1] + slack))))
        if outside > 0.0:
            share, fitted = f"{max(100 * outside, 1):.0f} % of the samples", f"{span[0]:.2f} to {span[1]:.2f} {unit}"
            warnings.append(f"in {share} the joint's {name} is outside {fitted}: the model was fitted there only")
    return warnings


def quality(model: Model, grid: Grid, rows: np.ndarray, converged: bool = True) -> dict[str, Any]:
    """The verdict on a model. It is stored in MODEL.json, and every page and command shows this one.

    A failed check of severity "refuse" makes a model not usable; one of severity "care" makes it usable with care.

    `verdict`: usable, usable with care, or not usable; `words`: one sentence with the main reason; `reasons`: the texts
    of the failed checks, "refuse" first; `gates`: the checks by name, {"passed", "severity", "says"}.
    """
    moving = depend_on_joint(str(entry["id"]) for entry in model.effects)
    gates = {
        "stable": _stable(model),
        "converged": _gate(converged, "care", "the search for the dynamics did not converge"),
        "torque": _torque(model, grid, rows),
        "joint": _joint_at_rest(model, grid, rows, moving),
        "monotone": _monotone(model),
        "range": _range(grid, rows),
        "ceiling": _ceiling(model, grid, rows),
        "held_out": _held_out(model),
        "gap": _gap(model),
        "residual": _residual(model, float(np.ptp(grid.torque_nm[rows]))),
        "joint_seen": _joint_seen(grid, rows, moving),
        "sensor": _sensor(grid, model.baseline_nm),
    }
    failed = [gate for gate in gates.values() if not gate["passed"]]
    failed.sort(key=lambda gate: gate["severity"] != "refuse")
    bad = any(gate["severity"] == "refuse" for gate in failed)
    verdict = "not usable" if bad else "usable with care" if failed else "usable"
    reasons = [gate["says"] for gate in failed]
    return {"verdict": verdict, "words": _words(model, bad, reasons), "reasons": reasons, "gates": gates}


def _words(model: Model, bad: bool, reasons: list[str]) -> str:
    if reasons:
        return f"{'Do not use this model' if bad else 'Check this before use'}: {reasons[0]}."
    reached, ceiling, where = _reach(model)[:3]
    return f"The model fits {reached:.1f} % on {where}; the noise allows about {ceiling:.1f} %."


def _gate(passed: bool, severity: str, message: str) -> dict[str, Any]:
    return {"passed": bool(passed), "severity": severity, "says": "" if passed else message}


def _stable(model: Model) -> dict[str, Any]:
    linear = model.linear
    stable = linear.stable if isinstance(linear, Discrete) else linear.time_constant_s > 0 and linear.damping > 0
    if stable and any(JointEffect.of(entry).form.stage == "term" for entry in model.effects):
        stable = _tame(model)
    return _gate(stable, "refuse", "the dynamics are unstable")


def _tame(model: Model) -> bool:
    """Return True if held widths keep the torque bounded: switching rates can pump energy, though each alone damps."""
    rng, joint = np.random.default_rng(0), Surfaces.of(model.effects)
    widths_us = np.repeat(rng.uniform(0.0, model.recruitment.basis.largest_us, PROBES), rng.integers(1, 40, PROBES))
    curve_nm = float(np.ptp(model.recruitment(np.linspace(0.0, model.recruitment.basis.largest_us, 101))))
    angle_rad = None if joint is None else np.full(widths_us.size, joint.reference_rad)
    try:
        return bool(np.max(np.abs(above_rest(model, widths_us, model.pulse_rate_hz, angle_rad))) < TAME * curve_nm)
    except RunsAway:
        return False


def _torque(model: Model, grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    table = model.recruitment(np.linspace(0.0, float(np.max(grid.pulse_width_us)), 101))
    spread = float(np.ptp(table))
    measured_nm = float(np.ptp(grid.torque_nm[rows]))
    finite = bool(np.all(np.isfinite(table))) and spread < 50 * max(measured_nm, 1e-12)
    if not finite:
        return _gate(False, "refuse", "the recruitment curve is far outside the measured torque")
    if spread > 4 * model.noise.block_sd_nm:
        return _gate(True, "refuse", "")
    message = "stimulation hardly changes the torque: check electrodes, current and load cell"
    return _gate(False, "refuse", _blame(model, grid, rows) or message)


def _blame(model: Model, grid: Grid, rows: np.ndarray) -> str:
    """Say what fails if not the record: a linear filter of width and squared width over the last second follows it.

    Empty if that does not follow the torque either.
    """
    width = grid.interval_means(grid.pulse_width_us)
    powers = np.stack([width, width**2]) / np.max(width) ** np.array([[1], [2]])
    lags = range(0, min(round(FILTER_S / grid.step_s), grid.size), 2)[: int(rows.sum()) // 20]
    design = np.vstack([np.ones(grid.size), *(np.pad(powers, ((0, 0), (lag, 0)))[:, : grid.size] for lag in lags)])
    design, torque_nm = design[:, rows].T, grid.torque_nm[rows]
    filter_nm = np.linalg.lstsq(design, torque_nm, rcond=1e-9)[0]
    follows = best_fit_percent(torque_nm, design @ filter_nm)
    if not follows > FOLLOWS_PERCENT:
        return ""
    cure = "an effect is missing; see the diagnosis"
    if model.method != "maximum-likelihood":
        cure = f"the method {model.method} fails on this record; fit with maximum-likelihood"
    return f"the torque follows the pulses (a linear filter fits {follows:.0f} %), and this model does not: {cure}"


def _monotone(model: Model) -> dict[str, Any]:
    basis = model.recruitment.basis
    table = model.recruitment(np.linspace(0.0, basis.largest_us, 201))
    sign = 1.0 if abs(table.max()) >= abs(table.min()) else -1.0
    dip = float(np.max(np.maximum.accumulate(sign * table) - sign * table))
    share = dip / max(float(np.ptp(table)), 1e-12)
    message = f"the recruitment curve falls by {100 * share:.0f} % of its range at one place: its inverse jumps there"
    return _gate(share <= LARGEST_DIP, "care", message)


def _range(grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    count = np.unique(grid.pulse_width_us[rows]).size
    message = f"only {count} pulse widths were fitted: between them the recruitment curve is a guess; record a ramp"
    return _gate(count >= 8, "care", message)


def _ceiling(model: Model, grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    fit, ceiling = _statistic(model, "fit_percent"), _statistic(model, "ceiling_percent")
    if not np.isfinite(fit) or not np.isfinite(ceiling):
        return _gate(False, "care", "the fit cannot be compared with what the noise allows")
    if fit < LEAST_FIT_PERCENT or (fit < 50.0 and ceiling > 60.0):
        cause = _blame(model, grid, rows) or "the torque hardly follows the pulses"
        return _gate(False, "refuse", f"the fit of {fit:.1f} % is too poor: {cause}")
    return _gate(
        fit >= ceiling - UNDER_CEILING_POINTS,
        "care",
        f"the fit of {fit:.1f} % is {ceiling - fit:.1f} points below what the noise allows ({ceiling:.1f} %): "
        "an effect is missing, or the noise is slow; see the diagnosis",
    )


def _held_out(model: Model) -> dict[str, Any]:
    error, fitted_error = _statistic(model, "held_out_rms_nm"), _statistic(model, "rms_nm")
    if not np.isfinite(error) or not np.isfinite(fitted_error):
        return _gate(True, "care", "")
    unpredictable_nm = float(model.fit.get("unforeseen_nm", 0.0))
    like = float(np.hypot(max(fitted_error, model.noise.white_sd_nm), unpredictable_nm))
    return _gate(
        error <= max(1.5 * like, NEGLIGIBLE * np.ptp(model.valid_for["torque_nm"])),
        "care",
        f"the error on {held_out_pulses(model.fit)}, {error:.3g} N·m, is "
        f"{error / max(fitted_error, 1e-12):.1f} times that on fitted pulses",
    )


def _gap(model: Model) -> dict[str, Any]:
    """Check that the fit on held-out pulses is near the one that the noise allows there.

    If the torque is constant there, their error above the noise is taken as a share of the fitted torque's spread.
    """
    reached, ceiling, where, error = _reach(model)
    gap = ceiling - reached
    noise = float(np.hypot(model.noise.white_sd_nm, model.fit.get("unforeseen_nm", 0.0)))
    message = f"on {where} the fit is {reached:.1f} %, and the noise allows {ceiling:.1f} %"
    unseen = _statistic(model, "held_out_rms_nm")
    if where == FITTED_PULSES and np.isfinite(unseen):
        gap, error = 100.0 * (unseen - noise) * (1.0 - reached / 100.0) / max(error, 1e-300), unseen
        pulses = held_out_pulses(model.fit)
        message = f"on {pulses}, whose torque is constant, the error is {unseen:.3g} N·m (noise {noise:.3g} N·m)"
    if not np.isfinite(gap):
        return _gate(True, "care", "")
    far = gap > LARGEST_GAP and not error <= WITHIN_NOISE * noise
    much = "too much" if far else "something"
    return _gate(gap <= GOOD_GAP, "refuse" if far else "care", f"{message}: {much} is missing; see the diagnosis")


def _reach(model: Model) -> tuple[float, float, str, float]:
    """Fit, ceiling, name of the rows and error there: of the held-out pulses, unless the torque is constant there."""
    prefix, where = "held_out_", held_out_pulses(model.fit)
    if not np.isfinite(_statistic(model, "held_out_fit_percent")):
        prefix, where = "", FITTED_PULSES
    names = ("fit_percent", "ceiling_percent", "rms_nm")
    reached, ceiling, error = (_statistic(model, prefix + name) for name in names)
    return reached, ceiling, where, error


def _statistic(model: Model, name: str) -> float:
    value = model.fit.get(name)
    return float("nan") if value is None else float(value)


def _residual(model: Model, span_nm: float) -> dict[str, Any]:
    if model.noise.block_sd_nm < NEGLIGIBLE * span_nm:
        return _gate(True, "care", "")
    failed = [name for name, test in model.residual_tests.items() if not test.get("passed", True)]
    return _gate(not failed, "care", f"the residual is not pure noise ({', '.join(failed)} test): see the diagnosis")


def _joint_at_rest(model: Model, grid: Grid, rows: np.ndarray, moving: bool) -> dict[str, Any]:
    if grid.angle_rad is None or moving:
        return _gate(True, "care", "")
    moved_rad = float(np.ptp(grid.angle_rad[rows]))
    little = moved_rad <= LARGEST_MOVE_RAD or _reach(model)[3] <= WITHIN_NOISE * model.noise.white_sd_nm
    message = f"the joint moved by {math.degrees(moved_rad):.0f}°, and the model is one of a joint at rest"
    return _gate(little, "care", f"{message}: hold it still, or add what depends on the joint")


def _joint_seen(grid: Grid, rows: np.ndarray, moving: bool) -> dict[str, Any]:
    if grid.angle_rad is None or not moving:
        return _gate(True, "care", "")
    # Quantiles, since one spike of the sensor is no movement.
    moved_rad = float(np.ptp(np.quantile(grid.angle_rad[rows], MOVED_QUANTILES)))
    message = f"the joint moved by {math.degrees(moved_rad):.0f}° only"
    message += ": what depends on it is a guess; move it in a test"
    return _gate(moved_rad > LARGEST_MOVE_RAD, "care", message)


def _sensor(grid: Grid, baseline_nm: float) -> dict[str, Any]:
    torque = grid.record.torque_nm
    span = float(np.ptp(torque))
    if not span > 0:
        return _gate(False, "refuse", "the torque never changes")
    for sign in (1.0, -1.0):
        top_nm = flat_top(sign * torque)
        if top_nm is None or abs(sign * top_nm - baseline_nm) <= 0.2 * span:
            continue
        at_edge = torque == sign * top_nm
        if np.any(at_edge & (grid.pulse_width_us[grid.interval] > 0)):
            message = f"the load cell clips at {sign * top_nm:.3g} N·m ({int(at_edge.sum())} samples)"
            return _gate(False, "care", message)
    return _gate(True, "care", "")

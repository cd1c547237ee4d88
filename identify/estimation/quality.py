"""For what a model holds, and whether it may be used: gates, and the one verdict on a model."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.dynamics.linear import Discrete
from identify.dynamics.pulse_grid import Grid
from identify.model import Model
from identify.records.record import Record
from identify.simulation.predict import refuse_rate

UNDER_CEILING_POINTS = 1.0
LARGEST_DIP = 0.05
LEAST_FIT_PERCENT = 30.0
GOOD_GAP, LARGEST_GAP = 2.0, 8.0
"""Points of fit below the ceiling on rows not seen: up to the first little is missing, above the second too much."""
WITHIN_NOISE = 1.3
"""Error over the noise up to which what is left passes for noise, however little the torque moves beside it."""
OWN = "its own rows"
NEGLIGIBLE = 5e-4
"""Share of the torque's range below which it doesn't matter what an error looks like."""


def valid_for(model: Model, grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    """Pulse widths, torques and rates that the fitted rows covered."""
    widths = grid.pulse_width_us[rows]
    largest = float(np.max(widths))
    table = model.recruitment(np.linspace(0.0, largest, 101))
    return {
        "pulse_width_us": [0.0, largest],
        "torque_nm": [float(min(table.min(), 0.0)), float(max(table.max(), 0.0))],
        "measured_torque_nm": [float(np.min(grid.torque_nm[rows])), float(np.max(grid.torque_nm[rows]))],
        "pulse_rate_hz": [model.pulse_rate_hz * 0.95, model.pulse_rate_hz * 1.05],
        "sample_rate_hz": [39.0, 2100.0],
        "memory_s": model.linear.memory_s,
    }


def check(model: Model, record: Record) -> list[str]:
    """Warnings where a record leaves what the model holds for; empty where it doesn't.

    Raises
    ------
    BadModel
        The pulse rate is another: recruitment and dynamics both change with it.
    """
    refuse_rate(model, record)
    warnings = []
    low, high = model.valid_for.get("pulse_rate_hz", (0.0, np.inf))
    if not low <= record.pulse_rate_hz <= high:
        warnings.append(
            f"fitted at {model.pulse_rate_hz:g} pulses a second, used at {record.pulse_rate_hz:g}: "
            "fit again at that rate"
        )
    largest = model.valid_for.get("pulse_width_us", (0.0, np.inf))[1]
    beyond = record.pulse_width_us > largest * (1 + 1e-6)
    if np.any(beyond):
        warnings.append(
            f"{100 * float(np.mean(beyond)):.0f} % of the pulse widths are above the largest fitted, {largest:g} µs: "
            "the recruitment curve is held level there"
        )
    return warnings


def quality(model: Model, grid: Grid, rows: np.ndarray, converged: bool = True) -> dict[str, Any]:
    """The one verdict on a model: everything that shows one shows this, from MODEL.json.

    A gate that refuses makes a model not usable; one that asks for care makes it usable with care, however many fail.

    Returns
    -------
    dict
        `verdict`: usable, usable with care, not usable; `words`: it in one sentence; `reasons`: what the failed gates
        say, those that refuse first; `gates`: name -> {"passed", "severity", "says"}.
    """
    gates = {
        "stable": _stable(model),
        "converged": _gate(converged, "care", "the search for the dynamics did not settle"),
        "torque": _torque(model, grid, rows),
        "monotone": _monotone(model),
        "range": _range(grid, rows),
        "ceiling": _ceiling(model),
        "held_out": _held_out(model),
        "gap": _gap(model),
        "residual": _residual(model, float(np.ptp(grid.torque_nm[rows]))),
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
        return f"{'Do not rely on it' if bad else 'Use it with care'}, since {reasons[0]}."
    reached, ceiling, where = _reach(model)[:3]
    return f"It fits {reached:.1f} % on {where}, where the noise allows {ceiling:.1f} %: little is left to explain."


def _gate(passed: bool, severity: str, says: str) -> dict[str, Any]:
    return {"passed": bool(passed), "severity": severity, "says": "" if passed else says}


def _stable(model: Model) -> dict[str, Any]:
    linear = model.linear
    if isinstance(linear, Discrete):
        return _gate(linear.stable, "refuse", "the dynamics are unstable")
    return _gate(linear.time_constant_s > 0 and linear.damping > 0, "refuse", "the dynamics are unstable")


def _torque(model: Model, grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    """Whether stimulation moves the torque at all, beside the noise."""
    table = model.recruitment(np.linspace(0.0, float(np.max(grid.pulse_width_us)), 101))
    spread = float(np.ptp(table))
    seen = float(np.ptp(grid.torque_nm[rows]))
    finite = bool(np.all(np.isfinite(table))) and spread < 50 * max(seen, 1e-12)
    if not finite:
        return _gate(False, "refuse", "the recruitment curve is far outside the torque that was measured")
    return _gate(
        spread > 4 * model.noise.block_sd_nm,
        "refuse",
        "stimulation hardly moves the torque: check electrodes, current and load cell",
    )


def _monotone(model: Model) -> dict[str, Any]:
    basis = model.recruitment.basis
    table = model.recruitment(np.linspace(0.0, basis.largest_us, 201))
    sign = 1.0 if abs(table.max()) >= abs(table.min()) else -1.0
    dip = float(np.max(np.maximum.accumulate(sign * table) - sign * table))
    share = dip / max(float(np.ptp(table)), 1e-12)
    return _gate(
        share <= LARGEST_DIP,
        "care",
        f"the recruitment curve falls by {100 * share:.0f} % of its range somewhere: its inverse jumps there",
    )


def _range(grid: Grid, rows: np.ndarray) -> dict[str, Any]:
    widths = np.unique(grid.pulse_width_us[rows])
    return _gate(
        widths.size >= 8,
        "care",
        f"only {widths.size} pulse widths were fitted: the recruitment curve between them is a guess; record a ramp",
    )


def _ceiling(model: Model) -> dict[str, Any]:
    fit, ceiling = _figure(model, "fit_percent"), _figure(model, "ceiling_percent")
    if not np.isfinite(fit) or not np.isfinite(ceiling):
        return _gate(False, "care", "the fit can't be compared with its ceiling")
    if fit < LEAST_FIT_PERCENT or (fit < 50.0 and ceiling > 60.0):
        return _gate(False, "refuse", f"the fit, {fit:.1f} %, is too poor: torque hardly follows the pulses")
    return _gate(
        fit >= ceiling - UNDER_CEILING_POINTS,
        "care",
        f"the fit, {fit:.1f} %, is {ceiling - fit:.1f} points below what the noise allows ({ceiling:.1f} %): "
        "an effect is missing, or the noise is slow; see the diagnosis",
    )


def _held_out(model: Model) -> dict[str, Any]:
    error, fitted_error = _figure(model, "held_out_rms_nm"), _figure(model, "rms_nm")
    if not np.isfinite(error) or not np.isfinite(fitted_error):
        return _gate(True, "care", "")
    return _gate(
        error
        <= max(1.5 * fitted_error, 1.5 * model.noise.white_sd_nm, NEGLIGIBLE * np.ptp(model.valid_for["torque_nm"])),
        "care",
        f"the error on rows not fitted, {error:.3g} N·m, is {error / max(fitted_error, 1e-12):.1f} times "
        "that on fitted ones",
    )


def _gap(model: Model) -> dict[str, Any]:
    """How far the fit on rows not seen stays below what the noise allows there.

    Where their torque is level, their error above the noise counts as a share of the fitted torque's spread.
    """
    reached, ceiling, where, error = _reach(model)
    gap, noise = ceiling - reached, model.noise.white_sd_nm
    says = f"on {where} it reaches {reached:.1f} % where the noise allows {ceiling:.1f} %"
    unseen = _figure(model, "held_out_rms_nm")
    if where == OWN and np.isfinite(unseen):
        gap, error = 100.0 * (unseen - noise) * (1.0 - reached / 100.0) / max(error, 1e-300), unseen
        says = f"on rows it has not seen, whose torque is level, it errs by {unseen:.3g} N·m (noise {noise:.3g})"
    if not np.isfinite(gap):
        return _gate(True, "care", "")
    far = gap > LARGEST_GAP and not error <= WITHIN_NOISE * noise
    much = "too much" if far else "something"
    return _gate(gap <= GOOD_GAP, "refuse" if far else "care", f"{says}: {much} is missing in it; see the diagnosis")


def _reach(model: Model) -> tuple[float, float, str, float]:
    """Fit, ceiling, the rows they hold for and the error there: rows not seen, where their torque isn't level."""
    prefix, where = "held_out_", "rows it has not seen"
    if not np.isfinite(_figure(model, "held_out_fit_percent")):
        prefix, where = "", OWN
    names = ("fit_percent", "ceiling_percent", "rms_nm")
    reached, ceiling, error = (_figure(model, prefix + name) for name in names)
    return reached, ceiling, where, error


def _figure(model: Model, name: str) -> float:
    """A figure of the fit; NaN where there is none."""
    value = model.fit.get(name)
    return float("nan") if value is None else float(value)


def _residual(model: Model, span_nm: float) -> dict[str, Any]:
    if model.noise.block_sd_nm < NEGLIGIBLE * span_nm:
        return _gate(True, "care", "")
    failed = [name for name, test in model.residual_tests.items() if not test.get("passed", True)]
    return _gate(not failed, "care", f"the residual is not noise ({', '.join(failed)} test): see the diagnosis")


def _sensor(grid: Grid, baseline_nm: float) -> dict[str, Any]:
    """Flat tops: many samples at exactly the largest (or smallest) torque."""
    torque = grid.record.torque_nm
    span = float(np.ptp(torque))
    if not span > 0:
        return _gate(False, "refuse", "the torque never changes")
    for edge in (float(np.max(torque)), float(np.min(torque))):
        at_edge = torque == edge
        in_a_row = np.max(np.diff(np.flatnonzero(np.r_[True, ~at_edge, True])) - 1, initial=0)
        driven = at_edge & (grid.pulse_width_us[grid.interval] > 0)
        if in_a_row >= 20 and driven.any() and abs(edge - baseline_nm) > 0.2 * span:
            return _gate(False, "care", f"the load cell is clipped at {edge:.3g} N·m ({int(at_edge.sum())} samples)")
    return _gate(True, "care", "")

"""Comparison of a model with a measurement: where the error is, and how much of it is noise."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.criticism.correlation import correlation_tests
from stimrig.identify.criticism.shares import error_shares
from stimrig.identify.criticism.where import worst_places
from stimrig.identify.dynamics.grid import Grid, make_grid
from stimrig.identify.errors import BadRecord
from stimrig.identify.estimation.fit_statistics import UNDEFINED, best_fit_percent, ceiling_percent, rms
from stimrig.identify.estimation.quality import range_warnings
from stimrig.identify.estimation.samples import inspect
from stimrig.identify.estimation.uncertainty import POINTWISE, prediction_band
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.identify.results import Comparison, FitStatistics

POINTS = 4000
"""Largest number of points of a plotted series."""
TOLD_S = 5e-3
"""Pulses at least this late are reported: a fifth of an interval, more than the jitter of a healthy computer."""
LEAST = 8
"""Fewer known intervals are not enough for any result."""


def compare(model: Model, record: Record) -> Comparison:
    """Compare a model with a measurement.

    Parameters
    ----------
    model : Model
        With effects or without.
    record : Record
        The record that the model was fitted on, or any other.

    Returns
    -------
    Comparison
        Fit statistics of all rows, of fitted and of held-out rows; the error by segment, level, direction, time and
        frequency; tests of the residual; the places of the largest error. Doubted samples count nowhere.

    Raises
    ------
    BadRecord
        Fewer than eight pulse intervals are known.
    """
    grid = make_grid(record)
    _refuse_doubted(grid)
    predicted = np.asarray(model.predict(record))
    raw = inspect(record)
    residual = record.torque_nm - predicted
    noise = raw.noise_sd_nm
    tests = correlation_tests(grid, residual)
    counted = grid.counted
    places = worst_places(record, residual, noise, rows=counted)
    held = record.held_out & counted
    whole = _figures(record, predicted, noise, counted)
    held_out = _figures(record, predicted, noise, held) if held.any() else None
    said = _left_out(grid)
    outside = [f"{warning[0].upper()}{warning[1:]}." for warning in range_warnings(model, record)]
    return Comparison(
        **whole,
        noise_sd_nm=noise,
        fitted=_figures(record, predicted, noise, ~record.held_out & counted),
        held_out=held_out,
        by=error_shares(record, residual, noise, counted),
        tests=tests,
        where=tuple(places),
        left_out=said,
        series=_series(model, record, predicted, noise),
        plain=(*_plain(whole, held_out, noise, tests, places), *([said] if said else []), *outside),
    )


def _figures(record: Record, predicted: np.ndarray, noise: float, rows: np.ndarray) -> FitStatistics:
    measured, guess = record.torque_nm[rows], predicted[rows]
    return {
        "fit_percent": best_fit_percent(measured, guess, noise),
        "ceiling_percent": ceiling_percent(measured, noise),
        "rms_nm": rms(measured - guess),
        "excess_rms_nm": float(np.sqrt(max(rms(measured - guess) ** 2 - noise**2, 0.0))),
        "samples": int(rows.sum()),
    }


def _series(model: Model, record: Record, predicted: np.ndarray, noise: float) -> dict[str, Any]:
    lower, upper = _band(model, record, predicted, noise)
    pick = slice(None, None, max(1, -(-record.time_s.size // POINTS)))
    names = np.array(record.segment_names)[record.segment]
    return {
        "time_s": record.time_s[pick],
        "pulse_width_us": record.pulse_width_us[pick],
        "torque_nm": record.torque_nm[pick],
        "predicted_torque_nm": predicted[pick],
        "lower_nm": lower[pick],
        "upper_nm": upper[pick],
        "residual_nm": (record.torque_nm - predicted)[pick],
        "noise_band_nm": POINTWISE * noise,
        "segment": names[pick].tolist(),
    }


def _band(model: Model, record: Record, predicted: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """95 % band for a measured sample: noise, and the model's uncertainty if the model has a covariance."""
    half = np.full(predicted.size, POINTWISE * noise)
    if model.covariance is not None:
        lower, upper = prediction_band(model, record)
        half = np.hypot(half, 0.5 * (upper - lower))
    return predicted - half, predicted + half


def _plain(
    whole: FitStatistics,
    held_out: FitStatistics | None,
    noise_sd_nm: float,
    tests: dict[str, Any],
    places: list[dict[str, Any]],
) -> list[str]:
    noise = f"the noise of {noise_sd_nm:.3g} N·m"
    if np.isfinite(whole["fit_percent"]):
        lines = [
            f"The model fits {whole['fit_percent']:.1f} %; {noise} allows {whole['ceiling_percent']:.1f} % at most."
        ]
    else:
        lines = [f"The error of the model is {whole['rms_nm']:.3g} N·m, with {noise}; its fit is {UNDEFINED}."]
    if held_out is not None:
        share = f"its fit is {UNDEFINED}"
        if np.isfinite(held_out["fit_percent"]):
            share = f"{held_out['fit_percent']:.1f} %, where the noise allows {held_out['ceiling_percent']:.1f} %"
        lines.append(f"On rows of `validate` its error is {held_out['rms_nm']:.3g} N·m ({share}).")
    alarms = [test["words"] for test in tests["tests"] if not test["passed"]]
    lines.append(" ".join(alarms) if alarms else "The remaining error looks like noise: no correlation is significant.")
    if alarms:
        lines += [f"{place['text']}." for place in places[:3]]
    return lines


def _left_out(grid: Grid) -> str:
    """One sentence: how much is left out, since it is not known which pulses acted there; empty if nothing was."""
    late = np.zeros(grid.size) if grid.late_s is None else np.where(grid.pulse_width_us > 0, grid.late_s, 0.0)
    pulses = int(np.sum(np.abs(late) >= TOLD_S)) + _lost(grid)
    seconds = float(np.sum(grid.doubted[grid.count > 0])) * grid.step_s
    if not pulses and not seconds:
        return ""
    told = "1 pulse came late or was lost" if pulses == 1 else f"{pulses} pulses came late or were lost"
    if not seconds:
        return f"{told}; the time of each is known, so nothing is left out."
    if not pulses:
        return f"{seconds:.1f} s are left out: the stimulation there is not known."
    return f"{told}; {seconds:.1f} s are left out, where the time of the pulses is not known."


def _refuse_doubted(grid: Grid) -> None:
    """Refuse a record of which hardly any stimulation is known."""
    if np.sum(~grid.doubted & (grid.count > 0)) < LEAST:
        raise BadRecord("nearly all samples are doubted", place="doubted", fix="Give a record with known pulses.")


def _lost(grid: Grid) -> int:
    known = grid.record.pulses
    if known is None:
        return 0
    inside = (known.time_s >= grid.start_s - grid.step_s) & (known.time_s <= grid.record.time_s[-1])
    return int(np.sum(known.lost & inside))

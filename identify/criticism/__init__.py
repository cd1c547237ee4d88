"""Measurement against model: where it errs, how much of that is noise, and whether the residual is only noise."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.criticism.correlation import correlation_tests
from identify.criticism.doubt import left_out, refuse_doubted
from identify.criticism.shares import by_direction, by_frequency, by_level, by_segment, by_time
from identify.criticism.where import worst_places
from identify.dynamics.pulse_grid import make_grid
from identify.estimation.figures import UNDEFINED, best_fit_percent, ceiling_percent, rms
from identify.estimation.prepare import inspect
from identify.estimation.quality import check
from identify.model import Model
from identify.records.record import Record
from identify.results import Comparison, Figures

POINTS = 4000
"""Points of a plotted series at most."""
BAND = 1.959964


def compare(model: Model, record: Record) -> Comparison:
    """A model against a measurement.

    Parameters
    ----------
    model : Model
        With effects or without.
    record : Record
        The one it was fitted on, or any other.

    Returns
    -------
    Comparison
        Figures of all rows, of the fitted and the held-out ones; the error split up, tested, placed and in words.
        What is doubted counts in no figure.

    Raises
    ------
    BadRecord
        It is nowhere known what was felt.
    """
    grid = make_grid(record)
    refuse_doubted(grid)
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
    said = left_out(grid)
    outside = [f"{warning[0].upper()}{warning[1:]}." for warning in check(model, record)]
    return Comparison(
        **whole,
        noise_sd_nm=noise,
        fitted=_figures(record, predicted, noise, ~record.held_out & counted),
        held_out=held_out,
        by={
            "segment": by_segment(record, residual, noise, counted),
            "level": by_level(record, residual, noise, counted),
            "direction": by_direction(record, residual, noise, counted),
            "time": by_time(record, residual, noise, counted),
            "frequency": by_frequency(record, residual, noise, counted),
        },
        tests=tests,
        where=tuple(places),
        left_out=said,
        series=_series(model, record, predicted, noise),
        plain=(*_plain(whole, held_out, noise, tests, places), *([said] if said else []), *outside),
    )


def _figures(record: Record, predicted: np.ndarray, noise: float, rows: np.ndarray) -> Figures:
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
        "noise_band_nm": BAND * noise,
        "segment": names[pick].tolist(),
    }


def _band(model: Model, record: Record, predicted: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """95 % band for a measured sample: the model's uncertainty, where it carries one, and the noise."""
    half = np.full(predicted.size, BAND * noise)
    if model.covariance is not None:
        from identify.estimation.uncertainty import prediction_band

        lower, upper = prediction_band(model, record)
        half = np.hypot(half, 0.5 * (upper - lower))
    return predicted - half, predicted + half


def _plain(
    whole: Figures, held_out: Figures | None, noise_sd_nm: float, tests: dict[str, Any], places: list[dict[str, Any]]
) -> list[str]:
    noise = f"noise of {noise_sd_nm:.3g} N·m"
    if np.isfinite(whole["fit_percent"]):
        lines = [f"The model fits {whole['fit_percent']:.1f} %; {noise} allows {whole['ceiling_percent']:.1f} %."]
    else:
        lines = [f"The model errs by {whole['rms_nm']:.3g} N·m beside {noise}; its fit is {UNDEFINED}."]
    if held_out is not None:
        share = f"its fit is {UNDEFINED}"
        if np.isfinite(held_out["fit_percent"]):
            share = f"{held_out['fit_percent']:.1f} %, at most {held_out['ceiling_percent']:.1f} %"
        lines.append(f"On rows it was not fitted on it errs by {held_out['rms_nm']:.3g} N·m ({share}).")
    alarms = [test["words"] for test in tests["tests"] if not test["passed"]]
    lines.append(" ".join(alarms) if alarms else "What is left looks like noise: none of the correlations stands out.")
    if alarms:
        lines += [f"{place['text']}." for place in places[:3]]
    return lines


__all__ = ["compare"]

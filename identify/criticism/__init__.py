"""Comparison of a model with a measurement: where the error is, and how much of it is noise.

The error by segment, level of pulse width, direction, time and frequency, without doubted samples; and its worst
places, named by segment, pulse width and direction.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from stimrig.identify.criticism.correlation import LAGS, correlation_tests
from stimrig.identify.dynamics.grid import Grid, make_grid, runs
from stimrig.identify.errors import BadRecord
from stimrig.identify.estimation.fit_statistics import UNDEFINED, figures, rms
from stimrig.identify.estimation.quality import range_warnings
from stimrig.identify.estimation.repetition import repetition
from stimrig.identify.estimation.rests import wandering_zero_nm
from stimrig.identify.estimation.samples import block_means, inspect
from stimrig.identify.estimation.uncertainty import POINTWISE, prediction_band, prediction_directions
from stimrig.identify.model import Model
from stimrig.identify.problem.predict import same_data
from stimrig.identify.records.record import Record
from stimrig.identify.results import Comparison
from stimrig.identify.yardstick import contradiction_words, repetition_sentences, zero_words

__all__ = ["compare"]

POINTS = 2400
"""Largest number of points of a plotted series."""
REPORTED_LATE_S = 5e-3
"""Pulses at least this late are reported: a fifth of an interval, more than the jitter of a healthy computer."""
SHORTEST_S = 3.0
"""With less than this beside `validate` the noise cannot be estimated: the record is compared as a whole."""
LEAST_INTERVALS = LAGS + 1
"""Fewer known intervals are not enough for any result: the residual is correlated over so many."""


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
        Fit statistics of all rows, of fitted and of held-out pulses; the error by segment, level, direction, time and
        frequency; tests of the residual; the places of the largest error. Doubted samples count nowhere. A record that
        is nearly all `validate` is compared as a whole: `held_out` is None, and `fitted` holds all rows.

    Raises
    ------
    BadRecord
        Fewer than `LEAST_INTERVALS` pulse intervals are known.
    """
    if np.sum(~record.held_out) < SHORTEST_S * record.sample_rate_hz:  # too few other rows to estimate the noise
        record = replace(record, segment_names=("all rows",) * len(record.segment_names))
    grid = make_grid(record)
    if np.sum(~grid.doubted & (grid.count > 0)) < LEAST_INTERVALS:
        fix = "Give a longer record, with known pulses."
        raise BadRecord(f"fewer than {LEAST_INTERVALS} pulse intervals are known", place="time_s", fix=fix)
    predicted = np.asarray(model.predict(record))
    raw = inspect(record)
    residual = record.torque_nm - predicted
    noise = raw.noise_sd_nm
    own_record = same_data(model, record)
    tests = correlation_tests(grid, residual, grid.fitted & own_record, prediction_directions(model, grid))
    alarms = [test["words"] for test in tests["tests"] if not test["passed"]]
    counted = grid.counted
    places = worst_places(record, residual, noise, rows=counted)
    held_out_rows = record.held_out & counted
    whole = _figures(record, predicted, noise, counted)
    held_out = _figures(record, predicted, noise, held_out_rows) if held_out_rows.any() else None
    left_out, errors = _left_out(grid), block_means(grid, residual)
    zero_nm = wandering_zero_nm(grid, ~grid.doubted & np.isfinite(errors), errors) if alarms else 0.0
    remarks = [text for text in (left_out, raw.readings.words if raw.readings else "") if text]
    remarks += [zero_words(zero_nm)] * bool(zero_nm)
    clean = replace(grid, torque_nm=block_means(grid, raw.torque_nm))
    known = model.fit if own_record else {}  # by errors of left-out rows, and by refits
    repeats = known.get("repetition") or repetition(clean, errors, grid.fitted)
    contradicts = contradiction_words(known.get("contradiction"))
    outside = [f"{warning[0].upper()}{warning[1:]}." for warning in range_warnings(model, record)]
    return Comparison(
        **whole,
        noise_sd_nm=noise,
        repetition=repeats,
        contradiction=known.get("contradiction"),
        fitted=_figures(record, predicted, noise, ~record.held_out & counted),
        held_out=held_out,
        by=_error_shares(record, residual, noise, counted),
        tests=tests,
        where=tuple(places),
        wandering_zero_nm=zero_nm,
        left_out=left_out,
        series=_series(model, record, predicted, noise),
        plain=(
            *_plain(whole, held_out, noise, alarms, places),
            *repetition_sentences({"repetition": repeats}),
            *([contradicts] if contradicts else []),
            *remarks,
            *outside,
        ),
    )


def _figures(record: Record, predicted: np.ndarray, noise: float, rows: np.ndarray) -> dict[str, Any]:
    statistics = figures(record.torque_nm[rows], predicted[rows], noise)
    excess = float(np.sqrt(max(statistics["rms_nm"] ** 2 - noise**2, 0.0)))
    return statistics | {"excess_rms_nm": excess, "samples": int(rows.sum())}


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
    whole: dict[str, Any],
    held_out: dict[str, Any] | None,
    noise_sd_nm: float,
    alarms: list[str],
    places: list[dict[str, Any]],
) -> list[str]:
    noise = f"the noise of {noise_sd_nm:.3g} N·m"
    if np.isfinite(whole["fit_percent"]):
        lines = [f"The model fits {whole['fit_percent']:.1f} %; {noise} allows about {whole['ceiling_percent']:.1f} %."]
    else:
        lines = [f"The error of the model is {whole['rms_nm']:.3g} N·m, with {noise}; its fit is {UNDEFINED}."]
    if held_out is not None:
        share = f"its fit is {UNDEFINED}"
        if np.isfinite(held_out["fit_percent"]):
            share = f"{held_out['fit_percent']:.1f} %, where the noise allows {held_out['ceiling_percent']:.1f} %"
        lines.append(f"On held-out pulses its error is {held_out['rms_nm']:.3g} N·m ({share}).")
    lines.append(" ".join(alarms) if alarms else "The remaining error looks like noise: no correlation is significant.")
    if alarms:
        lines += [f"{place['text']}." for place in places[:3]]
    return lines


def _left_out(grid: Grid) -> str:
    """One sentence: how much is left out, since it is not known which pulses acted there; empty if nothing was."""
    late = np.zeros(grid.size) if grid.late_s is None else np.where(grid.pulse_width_us > 0, grid.late_s, 0.0)
    pulses = int(np.sum(np.abs(late) >= REPORTED_LATE_S))
    if (known := grid.record.pulses) is not None:
        inside = (known.time_s >= grid.start_s - grid.step_s) & (known.time_s <= grid.record.time_s[-1])
        pulses += int(np.sum(known.lost & inside))
    seconds = float(np.sum(grid.doubted[grid.count > 0])) * grid.step_s
    if not pulses and not seconds:
        return ""
    how = "felt 5 ms late or more, or lost"
    affected = f"1 pulse was {how}" if pulses == 1 else f"{pulses} pulses were {how}"
    if not seconds:
        return f"{affected}; the time of each is known, so nothing is left out."
    if not pulses:
        return f"{seconds:.1f} s are left out: the stimulation there is not known."
    return f"{affected}; {seconds:.1f} s are left out, where the time of the pulses is not known."


# ---- shares of the error ----

LEVELS = 6
SPANS = 10
OCTAVES_HZ = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6, 51.2, 102.4, 204.8, 409.6, 1000.0)
Groups = list[tuple[str, np.ndarray]]
"""Labels and rows, bool, shape (N,)."""


def _error_shares(
    record: Record, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray
) -> dict[str, list[dict[str, Any]]]:
    """Tables of `Comparison.by`, of the samples that count."""
    sign, time_s = _direction_of(record), record.time_s - record.time_s[0]
    edges_s = np.linspace(0.0, time_s[-1] + 1e-9, SPANS + 1)
    kinds: dict[str, Groups] = {
        "segment": [(name, record.segment == i) for i, name in enumerate(record.segment_names)],
        "level": _levels(record.pulse_width_us),
        "direction": [("rising", sign > 0), ("falling", sign < 0), ("held", sign == 0)],
        "time": [(f"{a:.1f}-{b:.1f} s", (time_s >= a) & (time_s < b)) for a, b in pairwise(edges_s)],
    }
    tables = {kind: _table(groups, residual_nm, noise_sd_nm, counted) for kind, groups in kinds.items()}
    return tables | {"frequency": _frequency_rows(record.sample_rate_hz, residual_nm, noise_sd_nm, counted)}


def _levels(width_us: np.ndarray) -> Groups:
    """Zero, then equal ranges up to the largest width."""
    groups = [("0 µs", width_us <= 0)]
    for low, high in pairwise(np.linspace(0.0, float(width_us.max()), LEVELS + 1)):
        groups.append((f"{low:.0f}-{high:.0f} µs", (width_us > low) & (width_us <= high)))
    return groups


def _table(groups: Groups, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray) -> list[dict[str, Any]]:
    """For each group that counts: number of samples, error, mean, and share of the error above the noise."""
    parts = [(label, residual_nm[rows & counted]) for label, rows in groups if np.any(rows & counted)]
    table = [
        {"label": label, "samples": int(values.size), "rms_nm": rms(values), "mean_nm": float(np.mean(values))}
        for label, values in parts
    ]
    return _with_shares(table, [float(np.sum(values**2) - values.size * noise_sd_nm**2) for _, values in parts])


def _with_shares(table: list[dict[str, Any]], excess: list[float]) -> list[dict[str, Any]]:
    above = [max(value, 0.0) for value in excess]
    total = sum(above)
    shares = [value / total if total > 0 else 0.0 for value in above]
    return [row | {"share_of_excess": share} for row, share in zip(table, shares, strict=True)]


def _frequency_rows(
    rate: float, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray
) -> list[dict[str, Any]]:
    """By octave: root mean square of the residual and of white noise in each."""
    longest = max(runs(counted), key=lambda r: r.stop - r.start)
    values = residual_nm[longest]
    power = np.abs(np.fft.rfft(values)) ** 2 / values.size**2
    power[1:] *= 2.0
    frequency = np.fft.rfftfreq(values.size, 1.0 / rate)
    rows: list[dict[str, Any]] = []
    for low, high in pairwise(OCTAVES_HZ):
        inside = (frequency >= low) & (frequency < high)
        if not inside.any() or low >= rate / 2:
            continue
        top = min(high, rate / 2)
        rows.append(
            {
                "label": f"{low:g}-{top:g} Hz",
                "from_hz": low,
                "to_hz": top,
                "rms_nm": float(np.sqrt(power[inside].sum())),
                "noise_nm": noise_sd_nm * float(np.sqrt(inside.sum() / frequency.size)),
            }
        )
    return _with_shares(rows, [row["rms_nm"] ** 2 - row["noise_nm"] ** 2 for row in rows])


# ---- the worst places ----

STRETCH_S = 0.5
MAX_PLACES = 5
"""Largest number of places."""


def _direction_of(record: Record) -> np.ndarray:
    """+1 where the pulse width rose over the last 0.3 s, -1 where it fell, 0 where it was held; shape (N,)."""
    u = record.pulse_width_us
    back = max(round(0.3 * record.sample_rate_hz), 1)
    change = u - np.r_[np.full(back, u[0]), u[:-back]]
    level = 0.004 * max(float(u.max()), 1.0)
    return np.where(change > level, 1, np.where(change < -level, -1, 0))


def worst_places(
    record: Record, residual_nm: np.ndarray, noise_sd_nm: float, *, rows: np.ndarray
) -> list[dict[str, Any]]:
    """The stretches with most of the error above the noise, among `rows` that count, bool, shape (N,).

    As `where` in `diagnose --json`, worst first, with `mean_error_nm` (positive: the model is too low) and `text`.
    `residual_nm`: measured less predicted, shape (N,); `noise_sd_nm`: white noise of a sample.
    """
    length = max(round(STRETCH_S * record.sample_rate_hz), 1)
    rising, pieces = _direction_of(record), []
    for run in np.split(np.arange(record.time_s.size), np.flatnonzero(np.diff(record.segment)) + 1):
        for part in np.split(run, range(length, run.size, length)):
            counted_rows = part[rows[part]]
            if counted_rows.size >= 2:
                excess = float(np.sum(residual_nm[counted_rows] ** 2) - counted_rows.size * noise_sd_nm**2)
                pieces.append([int(part[0]), int(part[-1]) + 1, excess, int(np.sign(np.sum(rising[counted_rows])))])
    excess_total = sum(max(piece[2], 0.0) for piece in pieces)
    if excess_total <= 0.0:
        return []
    merged = sorted(_merge(pieces, record), key=lambda piece: -piece[2])
    return [
        _place(record, residual_nm, rows, piece, excess_total)
        for piece in merged[:MAX_PLACES]
        if piece[2] > 0.02 * excess_total
    ]


def _merge(pieces: list[list[Any]], record: Record) -> list[list[Any]]:
    """Join neighbouring stretches of the same segment and direction, if each has much of the error."""
    level = 0.3 * max(piece[2] / (piece[1] - piece[0]) for piece in pieces)
    result: list[list[Any]] = []
    for piece in pieces:
        strong = piece[2] / (piece[1] - piece[0]) > level
        last = result[-1] if strong and result and result[-1][4] else None
        if last and last[1] == piece[0] and last[3] == piece[3] and record.segment[last[0]] == record.segment[piece[0]]:
            last[1], last[2] = piece[1], last[2] + piece[2]
        else:
            result.append([*piece, strong])
    return result


def _place(record: Record, residual_nm: np.ndarray, rows: np.ndarray, piece: list[Any], total: float) -> dict[str, Any]:
    start, stop, excess, sign = piece[:4]
    name = record.segment_names[int(record.segment[start])]
    widths = record.pulse_width_us[start:stop]
    looked_at = residual_nm[start:stop][rows[start:stop]]
    error = float(np.mean(looked_at))
    direction = {1: "rising", -1: "falling", 0: "held"}[sign]
    share = excess / total
    return {
        "segment": name,
        "start_s": float(record.time_s[start]),
        "end_s": float(record.time_s[stop - 1]),
        "pulse_width_us": [float(widths.min()), float(widths.max())],
        "direction": direction,
        "share_of_excess": float(share),
        "mean_error_nm": error,
        "text": _words(name, widths, direction, error, float(np.sqrt(np.mean(looked_at**2))), share),
    }


def _words(name: str, widths: np.ndarray, direction: str, error: float, size: float, share: float) -> str:
    low, high = float(widths.min()), float(widths.max())
    span = f"{low:.0f} µs" if high - low < 0.5 else f"{low:.0f}-{high:.0f} µs"
    part = name if direction == "held" else f"{direction} {name}"
    if abs(error) > 0.6 * size:
        what = f"model too {'low' if error > 0 else 'high'} by {abs(error):.2g} N·m"
    else:
        what = f"error of {size:.2g} N·m in both directions"
    return f"{part}, {span}: {what}, {100 * share:.0f} % of the error above the noise"

"""Figures of a model, of several models side by side and of a recording without a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import Axis, Band, Curve, Figure, Label, Rule, Shade, band_of, half_widths, variable
from stimrig.api.clinical_words import segment_words
from stimrig.identify.records.record import HELD_OUT

SHOWN_BEYOND = 1.5
"""The unplayed plan is drawn up to this multiple of the played time, plus 2 s."""
PAUSE, PAUSE_S = 20.0, 2.0
"""A pause lasts more than so many of the usual steps in time, and more than so many seconds: no line crosses it."""
LETTER = 0.007
"""Width of a letter of a segment's name, as a share of a wide chart."""
LARGE = "comparison"
"""The figure with all lines."""
WIDTH_AXIS = Axis("Pulse width (µs)", fig.WIDTH)
TORQUE_AXIS = Axis("Steady torque (N·m)")
SHARE_AXIS = Axis("Share of the final torque (1)")


def model_figures(
    document: dict[str, Any], curves: dict[str, Any] | None, comparison: dict[str, Any] | None = None
) -> dict[str, Figure]:
    """Return all figures of a model's page; those that need the measurement only if there is one."""
    figures = {"recruitment": recruitment(document, curves)}
    if curves is not None:
        noise_sd_nm = (document.get("fit") or {}).get("noise_sd_nm")
        series = (comparison or {}).get("series")
        figures[LARGE] = measurement(curves, noise_sd_nm, series)
        figures["overview"] = measurement(curves, noise_sd_nm, series, first_screen=True)
        figures["step"] = step(document, curves["step_response"])
    return figures


# ---- torque, residual and pulse width over time -------------------------------------------------------------------


def measurement(
    curves: dict[str, Any], noise_sd_nm: float | None, series: dict[str, Any] | None = None, first_screen: bool = False
) -> Figure:
    """Return torque measured and predicted with its band, the residual, and the pulse width, on one time axis.

    For the first screen the figure is lower and without the pulse width.
    """
    shades, labels = segment_marks(curves["segments"])
    if noise_sd_nm:
        shades += (Shade("noise-band", low=-2 * noise_sd_nm, high=2 * noise_sd_nm, panel=1),)
    bands: tuple[Band, ...] = ()
    if series and series.get("lower_nm"):
        bands = (Band(series["time_s"], series["lower_nm"], series["upper_nm"], "95 % band of the model"),)
    panels = (Axis("Torque (N·m)", share=0.5), Axis("Residual (N·m)", share=0.25),
              Axis("Pulse width (µs)", from_zero=True, share=0.25))  # fmt: skip
    lines, time_s = measured_lines(curves), curves["time_s"]
    if first_screen:
        panels, lines = panels[:2], lines[:3]
    return Figure(
        Axis("Time (s)", fig.AT_TIME, (time_s[0], time_s[-1])), panels, lines, bands, shades, labels=labels,
        height=260 if first_screen else 720,
    )  # fmt: skip


def measured_lines(curves: dict[str, Any]) -> tuple[Curve, ...]:
    """Return torque measured and predicted (panel 0), residual (1) and pulse width (2) over time."""
    curves = broken_at_pauses(curves)
    time_s, torque_nm, predicted_nm = curves["time_s"], curves["torque_nm"], curves["predicted_torque_nm"]
    residual = [
        None if predicted is None or measured is None else round(measured - predicted, 5)
        for measured, predicted in zip(torque_nm, predicted_nm, strict=True)
    ]
    notes = fig.segment_names(time_s, curves["segments"])
    return (
        Curve(time_s, torque_nm, "measured", "measured", 3.2, value=fig.TORQUE, notes=notes),
        Curve(time_s, predicted_nm, "model, free run", "model", 1.8, value=fig.TORQUE),
        Curve(time_s, residual, "measured − model", "residual", 1.0, panel=1, value=fig.RESIDUAL, listed=False),
        Curve(time_s, curves["pulse_width_us"], "pulse width", "width", 1.2, step=True, panel=2, value=fig.WIDTH,
              listed=False),
    )  # fmt: skip


def broken_at_pauses(curves: dict[str, Any]) -> dict[str, Any]:
    """Return the curves with a point without a value in each pause between the recordings of a joined one."""
    time_s = np.asarray(curves["time_s"], dtype=float)
    steps_s = np.diff(time_s)
    usual_s = float(np.median(steps_s)) if steps_s.size else 0.0
    pauses = np.flatnonzero(steps_s > max(PAUSE * usual_s, PAUSE_S)) + 1
    if not pauses.size:
        return curves
    broken = dict(curves)
    broken["time_s"] = np.insert(time_s, pauses, (time_s[pauses - 1] + time_s[pauses]) / 2).tolist()
    for name in ("torque_nm", "predicted_torque_nm", "pulse_width_us"):
        if name in curves:
            parts = np.split(np.asarray(curves[name], dtype=object), pauses)
            broken[name] = [value for part in parts for value in (*part, None)][:-1]
    return broken


def segment_marks(segments: Sequence[dict[str, Any]]) -> tuple[tuple[Shade, ...], tuple[Label, ...]]:
    """Return shades of the segments, and their names where they have room; the held-out one stands out."""
    shades, labels, free_s = [], [], -math.inf
    letter_s = LETTER * (segments[-1]["end_s"] if segments else 0.0)
    for segment in segments:
        name, start_s, end_s = segment["name"], segment["start_s"], segment["end_s"]
        if name == "rest":
            continue
        shades.append(Shade("held-out" if name == HELD_OUT else "segment", start_s, end_s))
        text, middle_s = segment_words(name), (start_s + end_s) / 2
        half_s = letter_s * len(text) / 2
        if middle_s - half_s < free_s:
            continue  # it would be written over the name before it
        free_s = middle_s + half_s
        labels.append(Label(middle_s, text))
    return tuple(shades), tuple(labels)


def recorded(recording: dict[str, Any], plan_us: list[float], rate_hz: float, state: str) -> Figure:
    """Return a test without a model: torque and sent pulse widths until its end, and the plan beyond it, faint."""
    end_s = recording["pulses_end_s"]
    last_s = max([end_s, *recording["time_s"][-1:]])
    shades, labels = segment_marks(recording["segments"])
    curves = [
        Curve(recording["time_s"], recording["torque_nm"], "torque, measured", "model", 1.8, value=fig.TORQUE),
        Curve(recording["pulse_time_s"], recording["sent_pulse_width_us"], "pulse width, sent", "width", 1.8,
              step=True, panel=1, value=fig.WIDTH),
    ]  # fmt: skip
    rules: tuple[Rule, ...] = ()
    rest = [(k / rate_hz, width_us) for k, width_us in enumerate(plan_us) if k / rate_hz >= end_s - 0.5 / rate_hz]
    if rest:
        last_s = max(last_s, min(rest[-1][0] + 1.0 / rate_hz, SHOWN_BEYOND * end_s + 2.0))
        beyond_s, planned_us = zip(*[point for point in rest if point[0] <= last_s], strict=True)
        curves.append(Curve(beyond_s, planned_us, "planned, not played", "plan", 1.2, step=True, panel=1))
        rules = (Rule(end_s, f"{state} at {end_s:.1f} s", "residual", vertical=True),)
    panels = [Axis("Torque (N·m)", share=0.55), Axis("Pulse width (µs)", from_zero=True, share=0.4)]
    if recording.get("angle_deg"):
        curves.append(Curve(recording["angle_time_s"], recording["angle_deg"], "angle of the joint", "residual",
                            panel=2))  # fmt: skip
        panels.append(Axis("Angle (°)", share=0.3))
    x = Axis("Time (s)", fig.AT_TIME, (0.0, last_s))
    return Figure(x, tuple(panels), tuple(curves), shades=shades, rules=rules, labels=labels, height=460)


# ---- the recruitment curve and the step response ------------------------------------------------------------------


def recruitment(document: dict[str, Any], curves: dict[str, Any] | None = None) -> Figure:
    """Return the recruitment curve with its band; with a recording, what its ramp says on the way up and down."""
    curve, band = document["recruitment"], band_of(document, "recruitment", "pulse_width_us")
    width_us = curve["pulse_width_us"]
    lines = [Curve(width_us, curve["torque_nm"], "model", "model", 2.2, value=fig.TORQUE,
                   notes=half_widths(band, width_us))]  # fmt: skip
    points = ramp_points(document, curves) if curves else {}
    for way, label, marker in (("rising", "ramp up", "up"), ("falling", "ramp down", "down")):
        if way in points:
            lines.append(Curve(points[way]["pulse_width_us"], points[way]["torque_nm"], label, way, 0, marker=marker,
                               size=9, hollow=True, value=fig.TORQUE))  # fmt: skip
    return Figure(WIDTH_AXIS, (TORQUE_AXIS,), tuple(lines), (band,) if band else ())


def step(document: dict[str, Any], response: dict[str, list[float]]) -> Figure:
    """Return the linear part's step response with its band."""
    band, time_s = band_of(document, "step_response", "time_s"), response["time_s"]
    line = Curve(time_s, response["response"], "model", "model", 2.2, value=fig.SHARE, notes=half_widths(band, time_s))
    return Figure(Axis("Time (s)", fig.AT_TIME, (0.0, time_s[-1])), (SHARE_AXIS,), (line,), (band,) if band else ())


WINDOW_S = 0.6
"""A slope is taken over this long; a pulse width that jumps or turns within it has no direction."""
FASTEST_US_PER_S = 200.0
BINS = 16
LEAST_SAMPLES = 3


def ramp_points(document: dict[str, Any], curves: dict[str, Any]) -> dict[str, dict[str, list[float]]]:
    """Return what a slow ramp says of the recruitment curve on its way up and on its way down.

    A partial residual plot: the curve's own value plus what the measurement has more than the free run, at the pulse
    width in force one mean lag of the linear part earlier. Without hysteresis both directions lie on the curve.

    ``rising`` and ``falling``: ``pulse_width_us``, µs, and ``torque_nm``, N·m; absent where the recording has none.
    """
    time_s, width_us, torque_nm, predicted_nm = (
        np.asarray(curves[name], dtype=float)
        for name in ("time_s", "pulse_width_us", "torque_nm", "predicted_torque_nm")
    )
    if len(time_s) < 3:
        return {}
    step_s = (time_s[-1] - time_s[0]) / (len(time_s) - 1)
    lag, half = round(mean_lag_s(document["linear"]) / step_s), max(1, round(WINDOW_S / 2 / step_s))
    at = np.arange(half, len(time_s) - half - lag)
    if not at.size:
        return {}
    windows = np.lib.stride_tricks.sliding_window_view(width_us, 2 * half + 1)[: at.size]
    change, steps, top_us = windows[:, -1] - windows[:, 0], np.diff(windows, axis=1), width_us.max()
    turns = (steps.max(axis=1) > 0) & (steps.min(axis=1) < 0)
    slow = (abs(change) > 0.02 * top_us) & (abs(change) < FASTEST_US_PER_S * 2 * half * step_s)
    ramp = slow & ~turns & (abs(steps).max(axis=1) < 0.5 * abs(change))
    width_us, more_nm = width_us[at], (torque_nm - predicted_nm)[at + lag]
    bins = np.minimum(BINS - 1, (BINS * width_us / top_us).astype(int)) if top_us else np.zeros(at.size)
    curve, points = document["recruitment"], {}
    for way, sign in (("falling", -1), ("rising", 1)):
        there = ramp & (sign * change > 0) & np.isfinite(more_nm)
        groups = [there & (bins == number) for number in range(BINS)]
        means = [(width_us[group].mean(), more_nm[group].mean()) for group in groups if group.sum() >= LEAST_SAMPLES]
        if means:
            width, more = np.array(means).T
            torque = np.interp(width, curve["pulse_width_us"], curve["torque_nm"]) + more
            points[way] = {"pulse_width_us": width.round(2).tolist(), "torque_nm": torque.round(4).tolist()}
    return points


def mean_lag_s(linear: dict[str, Any]) -> float:
    """Return how far the torque of a ramp trails: 2 ζ T + delay for the second order, 0 where it is not known."""
    time_s, damping = linear.get("time_constant_s"), linear.get("damping")
    if time_s is None or damping is None:
        return 0.0
    return max(0.0, 2.0 * damping * time_s + (linear.get("delay_s") or 0.0))


# ---- several models -----------------------------------------------------------------------------------------------

COLOURS = tuple(f"series-{number}" for number in range(1, 7))
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
MAX_COMPARED = len(COLOURS)
BANDED = 3
"""With more models than this their bands would hide one another."""


def style(number: int) -> dict[str, str]:
    """Return colour and dash of the n-th model: either of them alone tells it from the others."""
    return {"colour": variable(COLOURS[number]), "dash": DASHES[number]}


def compared_recruitment(documents: Sequence[dict[str, Any]], names: Sequence[str]) -> Figure:
    """Return all recruitment curves; with their bands where they are few."""
    bands = [band_of(document, "recruitment", "pulse_width_us", "series-band") for document in documents]
    lines = [
        _series(document["recruitment"]["pulse_width_us"], document["recruitment"]["torque_nm"], name, number, True)
        for number, (document, name) in enumerate(zip(documents, names, strict=True))
    ]
    bands_shown = tuple(replace(band, listed=False) for band in bands if band) if len(documents) <= BANDED else ()
    return Figure(WIDTH_AXIS, (TORQUE_AXIS,), tuple(lines), bands_shown, height=380)


def compared_step(curves: Sequence[dict[str, Any] | None], names: Sequence[str]) -> Figure:
    """Return all step responses."""
    lines = [
        _series(each["step_response"]["time_s"], each["step_response"]["response"], name, number, False)
        for number, (each, name) in enumerate(zip(curves, names, strict=True))
        if each
    ]
    return Figure(Axis("Time (s)", fig.AT_TIME), (SHARE_AXIS,), tuple(lines), height=380)


def _series(x: Sequence[float], y: Sequence[float], name: str, number: int, torque: bool) -> Curve:
    value = fig.TORQUE if torque else fig.SHARE
    return Curve(x, y, name, COLOURS[number], 2.2, DASHES[number], value=value)

"""Figures of a model, of several models side by side and of a recording without a model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import Figure, axis, band, band_of, curve, figure, half_widths, time_axis
from stimrig.api.charts.joint_charts import joint_figures
from stimrig.api.clinical_words import segment_words
from stimrig.api.models import explanation
from stimrig.identify.records.record import HELD_OUT

SHOWN_BEYOND = 1.5
"""The unplayed plan is drawn up to this multiple of the played time, plus 2 s."""
PAUSE, PAUSE_S = 20.0, 2.0
"""A pause lasts more than so many of the usual steps in time, and more than so many seconds: no line crosses it."""
LETTER = 0.007
"""Width of a letter of a segment's name, as a share of a wide chart."""
OVERVIEW_PX, CURVE_PX = 320.0, 190.0
"""Heights of the measurement and of the recruitment curve in the first screen of a model's page."""
PULSE_WIDTH, TORQUE, SHARE = "Pulse width (µs)", "Steady torque (N·m)", "Share of the final torque (1)"
Segments = Sequence[Mapping[str, Any]]


def model_figures(
    document: dict[str, Any], curves: dict[str, Any] | None, comparison: dict[str, Any] | None = None
) -> dict[str, Figure]:
    """Return all figures of a model; those that need the measurement only if there is one."""
    figures = {"recruitment": recruitment(document), "curve": recruitment(document, CURVE_PX)}
    if curves is not None:
        noise_sd_nm, series = (document.get("fit") or {}).get("noise_sd_nm"), (comparison or {}).get("series")
        figures["comparison"] = measurement(curves, noise_sd_nm, series)
        figures["overview"] = measurement(curves, noise_sd_nm, series, first_screen=True)
        figures["step"] = step(document, curves["step_response"])
    return figures | free_effects(explanation.held_free(document)) | joint_figures(document)


# ---- torque, residual and pulse width over time -------------------------------------------------------------------


def measurement(
    curves: dict[str, Any], noise_sd_nm: float | None, series: dict[str, Any] | None = None, first_screen: bool = False
) -> Figure:
    """Return torque measured and predicted with its band, the residual, and the pulse width, on one time axis.

    For the first screen the figure is lower and without the pulse width.
    """
    shapes, names = segment_marks(curves["segments"])
    if noise_sd_nm:
        shapes.append(fig.level("noise-band", -2 * noise_sd_nm, 2 * noise_sd_nm, panel=1))
    traces = []
    if series and series.get("lower_nm"):
        traces += band(series["time_s"], series["lower_nm"], series["upper_nm"], "95 % band of the model")
    curves = broken_at_pauses(curves)
    time_s, torque_nm, predicted_nm = curves["time_s"], curves["torque_nm"], curves["predicted_torque_nm"]
    residual_nm = [
        None if predicted is None or measured is None else round(measured - predicted, 5)
        for measured, predicted in zip(torque_nm, predicted_nm, strict=True)
    ]
    traces += [
        curve(time_s, torque_nm, "measured", "measured", 3.2, hover=fig.TORQUE,
              notes=fig.segment_names(time_s, curves["segments"])),
        curve(time_s, predicted_nm, "model, free run", "model", 1.8, hover=fig.TORQUE),
        curve(time_s, residual_nm, "measured − model", "residual", 1.0, panel=1, hover=fig.RESIDUAL, listed=False),
    ]  # fmt: skip
    panels, shares = [axis("Torque (N·m)"), axis("Residual (N·m)")], [0.5, 0.25]
    if not first_screen:
        traces.append(curve(time_s, curves["pulse_width_us"], "pulse width", "width", 1.2, step=True, panel=2,
                            hover=fig.WIDTH, listed=False))  # fmt: skip
        panels, shares = [*panels, axis(PULSE_WIDTH, from_zero=True)], [*shares, 0.25]
    height = OVERVIEW_PX if first_screen else 720
    return figure(time_axis(time_s[0], time_s[-1]), panels, traces, shapes, names, height, shares)


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
    for name in ("torque_nm", "predicted_torque_nm", "pulse_width_us", "residual_nm"):
        if name in curves:
            parts = np.split(np.asarray(curves[name], dtype=object), pauses)
            broken[name] = [value for part in parts for value in (*part, None)][:-1]
    return broken


def segment_marks(segments: Segments) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return shades of the segments, and their names where they have room; the held-out one stands out."""
    shades, names, free_s = [], [], -math.inf
    letter_s = LETTER * (segments[-1]["end_s"] if segments else 0.0)
    for segment in segments:
        name, start_s, end_s = segment["name"], segment["start_s"], segment["end_s"]
        if name == "rest":
            continue
        shades.append(fig.shade("held-out" if name == HELD_OUT else "segment", start_s, end_s))
        words, middle_s = segment_words(name), (start_s + end_s) / 2
        half_s = letter_s * len(words) / 2
        if middle_s - half_s >= free_s:  # else it would be written over the name before it
            free_s = middle_s + half_s
            names.append(fig.name(middle_s, words))
    return shades, names


def recorded(recording: dict[str, Any], plan_us: list[float], rate_hz: float, state: str) -> Figure:
    """Return a test without a model: torque and sent pulse widths until its end, and the plan beyond it, faint."""
    end_s = recording["pulses_end_s"]
    last_s = max([end_s, *recording["time_s"][-1:]])
    shapes, names = segment_marks(recording["segments"])
    traces = [
        curve(recording["time_s"], recording["torque_nm"], "torque, measured", "model", 1.8, hover=fig.TORQUE),
        curve(recording["pulse_time_s"], recording["sent_pulse_width_us"], "pulse width, sent", "width", 1.8,
              step=True, panel=1, hover=fig.WIDTH),
    ]  # fmt: skip
    rest = [(k / rate_hz, width_us) for k, width_us in enumerate(plan_us) if k / rate_hz >= end_s - 0.5 / rate_hz]
    if rest:
        last_s = max(last_s, min(rest[-1][0] + 1.0 / rate_hz, SHOWN_BEYOND * end_s + 2.0))
        beyond_s, planned_us = zip(*[point for point in rest if point[0] <= last_s], strict=True)
        traces.append(curve(beyond_s, planned_us, "planned, not played", "plan", 1.2, step=True, panel=1))
        shapes.append(fig.rule(end_s, f"{state} at {end_s:.1f} s", "residual", upright=True))
    panels, shares = [axis("Torque (N·m)"), axis(PULSE_WIDTH, from_zero=True)], [0.55, 0.4]
    if recording.get("angle_deg"):
        traces.append(
            curve(recording["angle_time_s"], recording["angle_deg"], "angle of the joint", "residual", panel=2)
        )
        panels, shares = [*panels, axis("Angle (°)")], [*shares, 0.3]
    return figure(time_axis(0.0, last_s), panels, traces, shapes, names, 460, shares)


# ---- the recruitment curve, the step response, free effects -------------------------------------------------------


def recruitment(document: dict[str, Any], height: float = 340) -> Figure:
    """Return the recruitment curve with its band."""
    known, area = document["recruitment"], band_of(document, "recruitment", "pulse_width_us")
    line = curve(known["pulse_width_us"], known["torque_nm"], "model", "model", 2.2, hover=fig.TORQUE,
                 notes=half_widths(area, known["pulse_width_us"]))  # fmt: skip
    return figure(axis(PULSE_WIDTH, "%{x:.0f} µs"), [axis(TORQUE)], [*area, line], height=height)


def step(document: dict[str, Any], response: dict[str, list[float]]) -> Figure:
    """Return the linear part's step response with its band."""
    area, time_s = band_of(document, "step_response", "time_s"), response["time_s"]
    line = curve(time_s, response["response"], "model", "model", 2.2, hover=fig.SHARE, notes=half_widths(area, time_s))
    return figure(time_axis(0.0, time_s[-1]), [axis(SHARE)], [*area, line])


def free_effects(entries: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """Return a figure of each free effect by name: its curves, each with its band."""
    return {f"free-{entry['id']}": free_effect(entry) for entry in entries}


def free_effect(entry: Mapping[str, Any]) -> Figure:
    """Return what a free effect does: its curves, each with its band."""
    bands, lines = [], []
    for number, (name, known) in enumerate(entry["lines"].items()):
        lines.append(curve(entry["at"], known["value"], name, ("model", "measured")[number % 2], 2.2, hover=fig.SHARE))
        colour = "series-band" if number else "model-band"
        bands += band(entry["at"], known["lower"], known["upper"], colour=colour, listed=not number)
    return figure(axis(entry["driver"]), [axis(entry["axis"])], [*bands, *lines], height=270)


# ---- several models -----------------------------------------------------------------------------------------------

COLOURS = tuple(f"series-{number}" for number in range(1, 7))
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
MAX_COMPARED = len(COLOURS)
BANDED = 3
"""With more models than this their bands would hide one another."""


def compared(
    documents: Sequence[dict[str, Any]], curves: Sequence[dict[str, Any] | None], names: Sequence[str]
) -> dict[str, Figure]:
    """Return all recruitment curves, with their bands where they are few, and all step responses.

    Colour or dash alone tells a model from the others.
    """
    bands, steady, steps = [], [], []
    for number, (document, known, name) in enumerate(zip(documents, curves, names, strict=True)):
        style: Any = {"label": name, "colour": COLOURS[number], "width": 2.2, "dash": DASHES[number]}
        if len(documents) <= BANDED:
            bands += band_of(document, "recruitment", "pulse_width_us", colour="series-band", listed=False)
        table = document["recruitment"]
        steady.append(curve(table["pulse_width_us"], table["torque_nm"], **style))
        if known:
            steps.append(curve(known["step_response"]["time_s"], known["step_response"]["response"], **style))
    return {
        "Recruitment curves": figure(axis(PULSE_WIDTH), [axis(TORQUE)], [*bands, *steady], height=380),
        "Step responses": figure(axis("Time (s)"), [axis(SHARE)], steps, height=380),
    }

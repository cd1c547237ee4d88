"""Figures of a model, and of a recording without a model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stimrig.api.charts.figure import Axis, Band, Figure, Line, Mark, Note, Rule, Shade, time_axis
from stimrig.api.charts.joint_charts import joint_figures
from stimrig.api.clinical_words import segment_words
from stimrig.api.models import explanation
from stimrig.identify.records.record import HELD_OUT

SHOWN_BEYOND = 1.5
"""The unplayed plan is drawn up to this multiple of the played time, plus 2 s."""
PAUSE, PAUSE_S = 20.0, 2.0
"""A pause lasts more than so many of the usual steps in time, and more than so many seconds: no line crosses it."""
LETTER = 0.0113
"""Width of a letter of a segment's name, as a share of the time axis in the first screen of a model's page."""
OVERVIEW_PX, CURVE_PX = 320.0, 190.0
"""Heights of the measurement and of the recruitment curve in the first screen of a model's page."""
PULSE_WIDTH = "Pulse width (µs)"


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
    marks = segment_marks(curves["segments"])
    if noise_sd_nm:
        marks.append(Shade("noise-band", -2 * noise_sd_nm, 2 * noise_sd_nm, 1))
    if series and series.get("lower_nm"):
        marks.append(Band(series["time_s"], series["lower_nm"], series["upper_nm"], "95 % band of the model"))
    curves = broken_at_pauses(curves)
    time_s, torque_nm, predicted_nm = curves["time_s"], curves["torque_nm"], curves["predicted_torque_nm"]
    residual_nm = [
        None if predicted is None or measured is None else round(measured - predicted, 5)
        for measured, predicted in zip(torque_nm, predicted_nm, strict=True)
    ]
    marks += [
        Line(time_s, torque_nm, "measured", "measured", 3.2),
        Line(time_s, predicted_nm, "model, free run", "model", 1.8),
        Line(time_s, residual_nm, "measured − model", "residual", 1.0, panel=1, listed=False),
    ]
    panels, shares = [Axis("Torque (N·m)"), Axis("Residual (N·m)")], [0.5, 0.25]
    if not first_screen:
        marks.append(Line(time_s, curves["pulse_width_us"], "pulse width", "width", 1.2, step=True, panel=2,
                          listed=False))  # fmt: skip
        panels, shares = [*panels, Axis(PULSE_WIDTH, from_zero=True)], [*shares, 0.25]
    return Figure(time_axis(time_s[0], time_s[-1]), panels, marks, OVERVIEW_PX if first_screen else 720, shares)


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
    for name in ("torque_nm", "predicted_torque_nm", "pulse_width_us", "residual_nm", "value", "driver"):
        if name in curves:
            parts = np.split(np.asarray(curves[name], dtype=object), pauses)
            broken[name] = [value for part in parts for value in (*part, None)][:-1]
    return broken


def segment_marks(segments: Sequence[Mapping[str, Any]]) -> list[Mark]:
    """Return shades of the segments, and their names where they have room; the held-out one stands out."""
    marks: list[Mark] = []
    free_s, letter_s = -math.inf, LETTER * (segments[-1]["end_s"] if segments else 0.0)
    for segment in segments:
        name, start_s, end_s = segment["name"], segment["start_s"], segment["end_s"]
        if name == "rest":
            continue
        marks.append(Shade("held-out" if name == HELD_OUT else "segment", start_s, end_s))
        words, middle_s = segment_words(name), (start_s + end_s) / 2
        half_s = letter_s * len(words) / 2
        if middle_s - half_s >= free_s:  # else it would be written over the name before it
            free_s = middle_s + half_s
            marks.append(Note(middle_s, words))
    return marks


def recorded(recording: dict[str, Any], plan_us: list[float], rate_hz: float, state: str) -> Figure:
    """Return a test without a model: torque and sent pulse widths until its end, and the plan beyond it, faint."""
    end_s = recording["pulses_end_s"]
    last_s = max([end_s, *recording["time_s"][-1:]])
    marks = segment_marks(recording["segments"])
    marks += [
        Line(recording["time_s"], recording["torque_nm"], "torque, measured", "model", 1.8),
        Line(recording["pulse_time_s"], recording["sent_pulse_width_us"], "pulse width, sent", "width", 1.8,
             step=True, panel=1),
    ]  # fmt: skip
    rest = [(k / rate_hz, width_us) for k, width_us in enumerate(plan_us) if k / rate_hz >= end_s - 0.5 / rate_hz]
    if rest:
        last_s = max(last_s, min(rest[-1][0] + 1.0 / rate_hz, SHOWN_BEYOND * end_s + 2.0))
        beyond_s, planned_us = zip(*[point for point in rest if point[0] <= last_s], strict=True)
        marks.append(Line(beyond_s, planned_us, "planned, not played", "plan", 1.2, step=True, panel=1))
        marks.append(Rule(end_s, f"{state} at {end_s:.1f} s", "residual", upright=True))
    panels, shares = [Axis("Torque (N·m)"), Axis(PULSE_WIDTH, from_zero=True)], [0.55, 0.4]
    if recording.get("angle_deg"):
        angle = recording["angle_time_s"], recording["angle_deg"]
        marks.append(Line(*angle, "angle of the joint", "residual", panel=2))
        panels, shares = [*panels, Axis("Angle (°)")], [*shares, 0.3]
    return Figure(time_axis(0.0, last_s), panels, marks, 460, shares)


# ---- the recruitment curve, the step response, free effects -------------------------------------------------------


def recruitment(document: dict[str, Any], height: float = 340) -> Figure:
    """Return the recruitment curve with its band."""
    known = document["recruitment"]
    line = Line(known["pulse_width_us"], known["torque_nm"], "model", "model", 2.2)
    area = _band_of(document, "recruitment", "pulse_width_us")
    return Figure(Axis(PULSE_WIDTH), [Axis("Steady torque (N·m)")], [*area, line], height)


def step(document: dict[str, Any], response: dict[str, list[float]]) -> Figure:
    """Return the linear part's step response with its band."""
    line = Line(response["time_s"], response["response"], "model", "model", 2.2)
    area, x = _band_of(document, "step_response", "time_s"), time_axis(0.0, response["time_s"][-1])
    return Figure(x, [Axis("Share of the final torque (1)")], [*area, line])


def _band_of(document: dict[str, Any], curve: str, along: str) -> list[Band]:
    """Return a curve's band in MODEL.json; nothing where the method gives none."""
    known = ((document.get("uncertainty") or {}).get("bands") or {}).get(curve)
    return [Band(known[along], known["whole_lower"], known["whole_upper"])] if known else []


def free_effects(entries: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """Return two figures of each free effect by name: its law, and its course over the record."""
    laws = {f"free-{entry['id']}": free_effect(entry) for entry in entries}
    return laws | {f"course-{entry['id']}": free_course(entry) for entry in entries if "course" in entry}


def free_effect(entry: Mapping[str, Any]) -> Figure:
    """Return what a free effect does: its curves, each with its band."""
    bands, lines = [], []
    for number, (name, known) in enumerate(entry["lines"].items()):
        lines.append(Line(entry["at"], known["value"], name, ("model", "measured")[number % 2], 2.2))
        colour = "series-band" if number else "model-band"
        bands.append(Band(entry["at"], known["lower"], known["upper"], colour=colour, listed=not number))
    return Figure(Axis(entry["driver"]), [Axis(entry["axis"])], [*bands, *lines], 270)


def free_course(entry: Mapping[str, Any]) -> Figure:
    """Return what a free effect does over the record, and below it what drives it."""
    course = broken_at_pauses(entry["course"])
    time_s = course["time_s"]
    effect = Line(time_s, course["value"], "what it does", "model", 1.6)
    driver = Line(time_s, course["driver"], "what drives it", "measured", 1.2, panel=1)
    panels = [Axis(entry["axis"]), Axis(f"{entry['driven_by'].capitalize()} (share)")]
    return Figure(time_axis(time_s[0], time_s[-1]), panels, [effect, driver], 360, (0.55, 0.4))

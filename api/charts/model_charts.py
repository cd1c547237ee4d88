"""Plotly figures as plain objects: the same for the page and for reports."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from stimrig.api.charts import hover, ramp_directions
from stimrig.api.charts.config import said
from stimrig.api.charts.palette import role
from stimrig.api.clinical_words import segment_words
from stimrig.api.language import _, localised

INK, MEASURED, MODEL, STIMULUS, FAINT = (role(name) for name in ("residual", "measured", "model", "width", "plan"))
BAND, NOISE = role("model-band"), role("noise-band")
SHOWN_BEYOND = 1.5
"""Of the plan that was not played so much is drawn, in parts of what was."""
FONT = {"family": "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif", "size": 13, "color": role("ink")}
TOOLBAR_PX = 42
"""On the right of a chart: the buttons stand there one below the other, and cover neither legend nor line."""
PAUSE, PAUSE_S = 20.0, 2.0
"""A pause lasts more than so many of the usual steps in time, and more than so many seconds: no line crosses it."""
LETTER = 0.007
"""Width of a letter of a segment's name, as a share of a wide chart."""
SYMBOLS = {"rising": "triangle-up", "falling": "triangle-down"}


def axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis with its quantity and unit."""
    base = {
        "title": {"text": title, "standoff": 8, "font": {"size": 12}},
        "gridcolor": role("grid"),
        "zerolinecolor": role("zero"),
        "automargin": True,
    }
    return {**base, **more}


def layout(**more: Any) -> dict[str, Any]:
    """What all figures share."""
    return {
        "font": FONT,
        "paper_bgcolor": role("chart"),
        "plot_bgcolor": role("chart"),
        "margin": {"l": 64, "r": TOOLBAR_PX, "t": 24, "b": 48},
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom", "traceorder": "normal"},
        "modebar": {"orientation": "v", "bgcolor": "rgba(0,0,0,0)", "color": role("dim"),
                    "activecolor": role("accent")},
        "hovermode": "x unified",
        "hoverlabel": {"bgcolor": role("card"), "bordercolor": role("line"), "font": {"color": role("ink")}},
        "uirevision": "kept",
        **more,
    }  # fmt: skip


def line(
    x: Sequence[float | str], y: Sequence[float | None], name: str, colour: str, width: float = 1.6, **more: Any
) -> dict[str, Any]:
    """A line trace."""
    return {"type": "scatter", "mode": "lines", "x": x, "y": y, "name": name,
            "line": {"color": colour, "width": width, **more.pop("line", {})}, **more}  # fmt: skip


def box(x0: float, x1: float, fill: str, y0: float = 0, y1: float = 1, yref: str = "paper") -> dict[str, Any]:
    """A shade below the lines, over the whole height where nothing else is said."""
    return {"type": "rect", "xref": "x", "yref": yref, "x0": x0, "x1": x1, "y0": y0, "y1": y1, "fillcolor": fill,
            "line": {"width": 0}, "layer": "below"}  # fmt: skip


def of_model(
    document: dict[str, Any], curves: dict[str, Any] | None, comparison: dict[str, Any] | None = None
) -> dict[str, Any]:
    """All figures of a model's page; those that need the measurement only if there is one."""
    figures = {"recruitment": recruitment(document, curves)}
    if curves is not None:
        noise_sd_nm = (document.get("fit") or {}).get("noise_sd_nm")
        figures["comparison"] = measurement(curves, noise_sd_nm, (comparison or {}).get("series"))
        figures["step"] = step(document, curves["step_response"])
    return figures


def measurement(
    curves: dict[str, Any], noise_sd_nm: float | None, series: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Torque measured and predicted with its band, what is left, and the pulse width, on one time axis."""
    time_s = curves["time_s"]
    shapes, labels = segment_marks(curves["segments"])
    if noise_sd_nm:
        shapes.append(box(time_s[0], time_s[-1], NOISE, -2 * noise_sd_nm, 2 * noise_sd_nm, yref="y2"))
    return {
        "data": measured_lines(curves, series),
        "layout": layout(
            height=720,
            shapes=shapes,
            annotations=labels,
            hoversubplots="axis",
            legend={"orientation": "h", "x": 0, "y": 1.04, "yanchor": "bottom", "traceorder": "normal"},
            margin={"l": 64, "r": TOOLBAR_PX, "t": 60, "b": 48},
            xaxis=axis(_("Time (s)"), anchor="y3", range=[time_s[0], time_s[-1]], **hover.AT_TIME),
            yaxis=axis(_("Torque (N·m)"), domain=[0.52, 1.0]),
            yaxis2=axis(_("Residual (N·m)"), domain=[0.27, 0.46]),
            yaxis3=axis(_("Pulse width (µs)"), domain=[0.0, 0.2], rangemode="tozero"),
        ),
    }


def measured_lines(curves: dict[str, Any], series: dict[str, Any] | None) -> list[dict[str, Any]]:
    """The traces of the measurement: torque on y, residual on y2, pulse width on y3, all over the same x."""
    curves = broken_at_pauses(curves)
    time_s, torque_nm, predicted_nm = curves["time_s"], curves["torque_nm"], curves["predicted_torque_nm"]
    residual = [
        None if predicted is None or measured is None else round(measured - predicted, 5)
        for measured, predicted in zip(torque_nm, predicted_nm, strict=True)
    ]
    names = hover.segments_at(time_s, curves["segments"], segment_name)
    data = [
        line(time_s, torque_nm, _("measured"), MEASURED, 3.2,
             **hover.says(_("measured"), hover.TORQUE + hover.BESIDE, names)),
        line(time_s, predicted_nm, _("model, free run"), MODEL, 1.8, **hover.says(_("model"), hover.TORQUE)),
        line(time_s, residual, _("measured − model"), INK, 1.0, yaxis="y2", showlegend=False,
             **hover.says(_("measured − model"), hover.RESIDUAL)),
        line(time_s, curves["pulse_width_us"], _("pulse width"), STIMULUS, 1.2, yaxis="y3", showlegend=False,
             line={"shape": "hv"}, **hover.says(_("pulse width"), hover.WIDTH)),
    ]  # fmt: skip
    if series and series.get("lower_nm"):
        data[1:1] = filled(series["time_s"], series["lower_nm"], series["upper_nm"], _("95 %% band of the model"))
    return data


def broken_at_pauses(curves: dict[str, Any]) -> dict[str, Any]:
    """The curves with a point without a value in each pause between the recordings of a joined one."""
    time_s = curves["time_s"]
    steps_s = [after - before for before, after in pairwise(time_s)]
    usual_s = sorted(steps_s)[len(steps_s) // 2] if steps_s else 0.0
    pauses = [place + 1 for place, step_s in enumerate(steps_s) if step_s > max(PAUSE * usual_s, PAUSE_S)]
    if not pauses:
        return curves
    lines = ("torque_nm", "predicted_torque_nm", "pulse_width_us")
    broken: dict[str, list[Any]] = {name: list(curves[name]) for name in ("time_s", *lines)}
    for place in reversed(pauses):
        broken["time_s"].insert(place, (time_s[place - 1] + time_s[place]) / 2)
        for name in lines:
            broken[name].insert(place, None)
    return {**curves, **broken}


def segment_name(name: str) -> str:
    """What a person calls a segment, for a chart."""
    return said(segment_words(name))


def segment_marks(segments: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Shades of the segments, and their names where they have room; the held-out one stands out."""
    shapes, labels, free_s = [], [], -math.inf
    letter_s = LETTER * (segments[-1]["end_s"] if segments else 0.0)
    for segment in segments:
        name, start_s, end_s = segment["name"], segment["start_s"], segment["end_s"]
        if name == "rest":
            continue
        shapes.append(box(start_s, end_s, role("held-out" if name == "validate" else "segment")))
        text, middle_s = segment_name(name), (start_s + end_s) / 2
        half_s = letter_s * len(text) / 2
        if middle_s - half_s < free_s:
            continue  # it would be written over the name before it
        free_s = middle_s + half_s
        labels.append({"xref": "x", "yref": "paper", "x": middle_s, "y": 1.0, "yanchor": "bottom",
                       "text": text, "showarrow": False,
                       "font": {"size": 12, "color": role("mark")}})  # fmt: skip
    return shapes, labels


def band_of(document: dict[str, Any], curve: str) -> dict[str, Any]:
    """A curve's band in MODEL.json; empty where the method gives none."""
    return ((document.get("uncertainty") or {}).get("bands") or {}).get(curve) or {}


def filled(
    x: Sequence[float], lower: Sequence[float], upper: Sequence[float], words: str, fill: str = BAND
) -> list[dict[str, Any]]:
    """Two traces with the band between them filled."""
    return [
        line(x, upper, "", MODEL, 0, showlegend=False, **hover.QUIET),
        line(x, lower, words, MODEL, 0, fill="tonexty", fillcolor=fill, **hover.QUIET),
    ]


def band(x: Sequence[float], lower: Sequence[float], upper: Sequence[float]) -> list[dict[str, Any]]:
    """A curve's band."""
    return filled(x, lower, upper, _("95 %% band"))


def recruitment(document: dict[str, Any], curves: dict[str, Any] | None = None) -> dict[str, Any]:
    """The recruitment curve with its band; with a recording's curves, what its ramp says on the way up and down."""
    curve, known = document["recruitment"], band_of(document, "recruitment")
    width_us = curve["pulse_width_us"]
    data = band(known["pulse_width_us"], known["whole_lower"], known["whole_upper"]) if known else []
    data.append(line(width_us, curve["torque_nm"], _("model"), MODEL, 2.2,
                     **hover.with_band(_("model"), hover.TORQUE, width_us, known, "pulse_width_us")))  # fmt: skip
    words = {"rising": _("ramp up"), "falling": _("ramp down")}
    for way, points in sorted(ramp_directions.seen(document, curves).items(), reverse=True) if curves else []:
        marker = {"symbol": SYMBOLS[way], "size": 9, "color": role("chart"),
                  "line": {"color": role(way), "width": 1.8}}  # fmt: skip
        data.append(line(points["pulse_width_us"], points["torque_nm"], words[way], role(way), mode="markers",
                         marker=marker, **hover.says(words[way], hover.TORQUE)))  # fmt: skip
    x, y = axis(_("Pulse width (µs)"), **hover.AT_WIDTH), axis(_("Steady torque (N·m)"))
    return {"data": data, "layout": layout(height=340, xaxis=x, yaxis=y, showlegend=len(data) > 1)}


def step(document: dict[str, Any], response: dict[str, list[float]]) -> dict[str, Any]:
    """The linear part's step response with its band."""
    known = band_of(document, "step_response")
    data = band(known["time_s"], known["whole_lower"], known["whole_upper"]) if known else []
    data.append(line(response["time_s"], response["response"], _("model"), MODEL, 2.2,
                     **hover.with_band(_("model"), hover.SHARE, response["time_s"], known, "time_s")))  # fmt: skip
    x = axis(_("Time (s)"), range=[0, response["time_s"][-1]], **hover.AT_TIME)
    y = axis(_("Share of the final torque (1)"))
    return {"data": data, "layout": layout(height=340, xaxis=x, yaxis=y, showlegend=bool(known))}


def recorded(found: dict[str, Any], plan_us: list[float], rate_hz: float, how: str) -> dict[str, Any]:
    """A test without a model: what was measured and sent until its end, and what was planned beyond it, faint."""
    end_s = found["pulses_end_s"]
    last_s = max([end_s, *found["time_s"][-1:]])
    data = [
        line(found["time_s"], found["torque_nm"], _("torque, measured"), MODEL, 1.8),
        line(found["pulse_time_s"], found["sent_pulse_width_us"], _("pulse width, sent"), STIMULUS, 1.8, yaxis="y2",
             line={"shape": "hv"}),
    ]  # fmt: skip
    rest = [(k / rate_hz, width_us) for k, width_us in enumerate(plan_us) if k / rate_hz >= end_s - 0.5 / rate_hz]
    shapes, labels = segment_marks(found["segments"])
    if rest:
        last_s = max(last_s, min(rest[-1][0] + 1.0 / rate_hz, SHOWN_BEYOND * end_s + 2.0))
        kept = [(at_s, width_us) for at_s, width_us in rest if at_s <= last_s]
        beyond_s, planned_us = zip(*kept, strict=True)
        data.append(line(list(beyond_s), list(planned_us), _("planned, not played"), FAINT, 1.2,
                         yaxis="y2", line={"shape": "hv"}))  # fmt: skip
        shapes.append({"type": "line", "xref": "x", "yref": "paper", "x0": end_s, "x1": end_s, "y0": 0, "y1": 1,
                       "line": {"color": INK}})  # fmt: skip
        labels.append(
            {
                "xref": "x",
                "yref": "paper",
                "x": end_s,
                "y": 0.42,
                "text": said(_("%(how)s at %(time)s s", how=how, time=localised(f"{end_s:.1f}"))),
            }
        )
    moves = bool(found.get("angle_deg"))
    if moves:
        data.append(line(found["angle_time_s"], found["angle_deg"], _("angle of the joint"), INK, 1.6, yaxis="y3"))
    panels = ([0.6, 1.0], [0.0, 0.2], [0.3, 0.5]) if moves else ([0.48, 1.0], [0.0, 0.36], None)
    more = {"yaxis3": axis(_("Angle (°)"), domain=panels[2])} if moves else {}
    return {
        "data": data,
        "layout": layout(
            shapes=shapes, annotations=labels,
            xaxis=axis(_("Time (s)"), range=[0.0, last_s]), yaxis=axis(_("Torque (N·m)"), domain=panels[0]),
            yaxis2=axis(_("Pulse width (µs)"), domain=panels[1], rangemode="tozero"), **more,
        ),
    }  # fmt: skip

"""Plotly figures as plain objects: the same for the page and for reports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from api.charts import ramp_directions
from api.charts.config import said

INK, MEASURED, MODEL, BAND, STIMULUS, GRID = (
    "#1b2733",
    "#a9b4be",
    "#0b6b75",
    "rgba(11,107,117,.15)",
    "#b4690e",
    "#e6eaee",
)
FAINT = "#d3dae0"
SHOWN_BEYOND = 1.5
"""Of the plan that was not played so much is drawn, in parts of what was."""
SEGMENT_FILL = {"validate": "rgba(180,105,14,.07)", "rest": "rgba(0,0,0,0)"}
FONT = {"family": "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif", "size": 13, "color": INK}


SYMBOLS, WORDS = {"rising": "triangle-up", "falling": "triangle-down"}, {"rising": "up", "falling": "down"}


def axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis with its quantity and unit."""
    base = {
        "title": {"text": title, "standoff": 8, "font": {"size": 12}},
        "gridcolor": GRID,
        "zerolinecolor": "#c3ccd4",
        "automargin": True,
    }
    return {**base, **more}


def layout(**more: Any) -> dict[str, Any]:
    """What all figures share."""
    return {
        "font": FONT,
        "paper_bgcolor": "#fff",
        "plot_bgcolor": "#fff",
        "margin": {"l": 64, "r": 16, "t": 24, "b": 48},
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom", "traceorder": "normal"},
        "hovermode": "x unified",
        **more,
    }


def line(
    x: Sequence[float | str], y: Sequence[float | None], name: str, colour: str, width: float = 1.6, **more: Any
) -> dict[str, Any]:
    """A line trace."""
    return {"type": "scatter", "mode": "lines", "x": x, "y": y, "name": name,
            "line": {"color": colour, "width": width, **more.pop("line", {})}, **more}  # fmt: skip


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
    residual = [
        None if predicted is None else round(measured - predicted, 5)
        for measured, predicted in zip(curves["torque_nm"], curves["predicted_torque_nm"], strict=True)
    ]
    data = [
        line(time_s, curves["torque_nm"], "measured", MEASURED, 3.2),
        line(time_s, curves["predicted_torque_nm"], "model, free run", MODEL, 1.8),
        line(time_s, residual, "measured − model", INK, 1.0, yaxis="y2", showlegend=False),
        line(time_s, curves["pulse_width_us"], "pulse width", STIMULUS, 1.2, yaxis="y3", showlegend=False,
             line={"shape": "hv"}),
    ]  # fmt: skip
    if series and series.get("lower_nm"):
        quiet = {"hoverinfo": "skip"}
        data[1:1] = [
            line(series["time_s"], series["upper_nm"], "", MODEL, 0, showlegend=False, **quiet),
            line(series["time_s"], series["lower_nm"], "95 % band of the model", MODEL, 0, fill="tonexty",
                 fillcolor=BAND, **quiet),
        ]  # fmt: skip
    shapes, labels = segment_marks(curves["segments"])
    if noise_sd_nm:
        shapes.append(
            {"type": "rect", "xref": "x", "yref": "y2", "x0": time_s[0], "x1": time_s[-1], "y0": -2 * noise_sd_nm,
             "y1": 2 * noise_sd_nm, "fillcolor": BAND, "line": {"width": 0}, "layer": "below"}
        )  # fmt: skip
    return {
        "data": data,
        "layout": layout(
            height=720,
            shapes=shapes,
            annotations=labels,
            legend={"orientation": "h", "x": 0, "y": 1.04, "yanchor": "bottom", "traceorder": "normal"},
            margin={"l": 64, "r": 16, "t": 60, "b": 48},
            xaxis=axis("Time (s)", anchor="y3", range=[time_s[0], time_s[-1]]),
            yaxis=axis("Torque (N·m)", domain=[0.52, 1.0]),
            yaxis2=axis("Residual (N·m)", domain=[0.27, 0.46]),
            yaxis3=axis("Pulse width (µs)", domain=[0.0, 0.2], rangemode="tozero"),
        ),
    }


def segment_marks(segments: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Shades and names of the segments; the held-out one stands out."""
    shapes, labels = [], []
    for segment in segments:
        name, start_s, end_s = segment["name"], segment["start_s"], segment["end_s"]
        if name == "rest":
            continue
        shapes.append({"type": "rect", "xref": "x", "yref": "paper", "x0": start_s, "x1": end_s, "y0": 0, "y1": 1,
                       "fillcolor": SEGMENT_FILL.get(name, "rgba(27,39,51,.035)"), "line": {"width": 0},
                       "layer": "below"})  # fmt: skip
        words = "validate (held out)" if name == "validate" else said(name)
        labels.append({"xref": "x", "yref": "paper", "x": (start_s + end_s) / 2, "y": 1.0, "yanchor": "bottom",
                       "text": words, "showarrow": False, "font": {"size": 12, "color": "#52606d"}})  # fmt: skip
    return shapes, labels


def band_of(document: dict[str, Any], curve: str) -> dict[str, Any]:
    """A curve's band in MODEL.json; empty where the method gives none."""
    return ((document.get("uncertainty") or {}).get("bands") or {}).get(curve) or {}


def band(x: Sequence[float], lower: Sequence[float], upper: Sequence[float]) -> list[dict[str, Any]]:
    """Two traces with the band between them filled."""
    quiet = {"hoverinfo": "skip"}
    return [
        line(x, upper, "", MODEL, 0, showlegend=False, **quiet),
        line(x, lower, "95 % band", MODEL, 0, fill="tonexty", fillcolor=BAND, **quiet),
    ]


def recruitment(document: dict[str, Any], curves: dict[str, Any] | None = None) -> dict[str, Any]:
    """The recruitment curve with its band; with a recording's curves, what its ramp says on the way up and down."""
    curve, known = document["recruitment"], band_of(document, "recruitment")
    data = band(known["pulse_width_us"], known["whole_lower"], known["whole_upper"]) if known else []
    data.append(line(curve["pulse_width_us"], curve["torque_nm"], "model", MODEL, 2.2))
    for way, points in sorted(ramp_directions.seen(document, curves).items(), reverse=True) if curves else []:
        marker = {"symbol": SYMBOLS[way], "size": 9, "color": "#fff", "line": {"color": STIMULUS, "width": 1.8}}
        data.append(line(points["pulse_width_us"], points["torque_nm"], f"ramp {WORDS[way]}", STIMULUS, mode="markers",
                         marker=marker))  # fmt: skip
    x, y = axis("Pulse width (µs)"), axis("Steady torque (N·m)")
    return {"data": data, "layout": layout(height=340, xaxis=x, yaxis=y, showlegend=len(data) > 1)}


def step(document: dict[str, Any], response: dict[str, list[float]]) -> dict[str, Any]:
    """The linear part's step response with its band."""
    known = band_of(document, "step_response")
    data = band(known["time_s"], known["whole_lower"], known["whole_upper"]) if known else []
    data.append(line(response["time_s"], response["response"], "model", MODEL, 2.2))
    x = axis("Time (s)", range=[0, response["time_s"][-1]])
    y = axis("Share of the final torque (1)")
    return {"data": data, "layout": layout(height=340, xaxis=x, yaxis=y, showlegend=bool(known))}


def recorded(found: dict[str, Any], plan_us: list[float], rate_hz: float, how: str) -> dict[str, Any]:
    """A test without a model: what was measured and sent until its end, and what was planned beyond it, faint."""
    end_s = found["pulses_end_s"]
    last_s = max([end_s, *found["time_s"][-1:]])
    data = [
        line(found["time_s"], found["torque_nm"], "torque, measured", MODEL, 1.8),
        line(found["pulse_time_s"], found["sent_pulse_width_us"], "pulse width, sent", STIMULUS, 1.8, yaxis="y2",
             line={"shape": "hv"}),
    ]  # fmt: skip
    rest = [(k / rate_hz, width_us) for k, width_us in enumerate(plan_us) if k / rate_hz >= end_s - 0.5 / rate_hz]
    shapes, labels = segment_marks(found["segments"])
    if rest:
        last_s = max(last_s, min(rest[-1][0] + 1.0 / rate_hz, SHOWN_BEYOND * end_s + 2.0))
        kept = [(at_s, width_us) for at_s, width_us in rest if at_s <= last_s]
        data.append(line([at_s for at_s, _ in kept], [width_us for _, width_us in kept], "planned, not played", FAINT,
                         1.2, yaxis="y2", line={"shape": "hv"}))  # fmt: skip
        shapes.append({"type": "line", "xref": "x", "yref": "paper", "x0": end_s, "x1": end_s, "y0": 0, "y1": 1,
                       "line": {"color": INK}})  # fmt: skip
        labels.append({"xref": "x", "yref": "paper", "x": end_s, "y": 0.42, "text": said(f"{how} at {end_s:.1f} s")})
    return {
        "data": data,
        "layout": layout(
            shapes=shapes, annotations=labels,
            xaxis=axis("Time (s)", range=[0.0, last_s]), yaxis=axis("Torque (N·m)", domain=[0.48, 1.0]),
            yaxis2=axis("Pulse width (µs)", domain=[0.0, 0.36], rangemode="tozero"),
        ),
    }  # fmt: skip

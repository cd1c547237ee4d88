"""Figures of "Why does it fail?": the residual with its worst places, signatures, the falling error."""

from __future__ import annotations

from typing import Any

from api.charts.config import said
from api.charts.model_charts import BAND, INK, MEASURED, MODEL, STIMULUS, axis, layout, line, segment_marks

MARK, MARK_LINE = "rgba(179,18,29,.10)", "#b3121d"


def residual(
    comparison: dict[str, Any], segments: list[dict[str, Any]], places: list[dict[str, Any]]
) -> dict[str, Any]:
    """Measurement minus model over time, the noise band, the worst places marked with their numbers."""
    series = comparison["series"]
    time_s, band = series["time_s"], series.get("noise_band_nm") or 0.0
    shapes, labels = segment_marks(segments)
    shapes.append(_box(time_s[0], time_s[-1], -band, band, BAND, yref="y"))
    for place in places:
        shapes.append(_box(place["start_s"], place["end_s"], 0, 1, MARK))
        labels.append({
            "xref": "x", "yref": "paper", "x": (place["start_s"] + place["end_s"]) / 2, "y": 0.985, "yanchor": "top",
            "text": f"<b>{place['number']}</b>", "showarrow": False, "font": {"size": 12, "color": "#fff"},
            "bgcolor": MARK_LINE, "borderpad": 3, "name": "place",
        })  # fmt: skip
    data = [line(time_s, series["residual_nm"], "measured − model", INK, 0.9)]
    return {
        "data": data,
        "layout": layout(
            height=320, shapes=shapes, annotations=labels, showlegend=False,
            margin={"l": 64, "r": 16, "t": 30, "b": 48},
            xaxis=axis("Time (s)", range=[time_s[0], time_s[-1]]), yaxis=axis("Measured − model (N·m)"),
        ),
    }  # fmt: skip


def _box(x0: float, x1: float, y0: float, y1: float, fill: str, yref: str = "paper") -> dict[str, Any]:
    return {"type": "rect", "xref": "x", "yref": yref, "x0": x0, "x1": x1, "y0": y0, "y1": y1, "fillcolor": fill,
            "line": {"width": 0}, "layer": "below"}  # fmt: skip


def signature(time_s: list[float], found: dict[str, list[float]]) -> dict[str, Any]:
    """What is left without an effect, and what adding it explains of that."""
    data = [
        line(time_s, found["seen_nm"], "seen: left without it", MEASURED, 1.8),
        line(time_s, found["expected_nm"], "expected: what it explains", MODEL, 1.8),
    ]
    x, y = axis("Time (s)", range=[time_s[0], time_s[-1]]), axis("Torque (N·m)")
    return {"data": data, "layout": layout(height=250, xaxis=x, yaxis=y, margin={"l": 56, "r": 10, "t": 30, "b": 42})}


def falling(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Error over the versions, with the noise as the line to fall to."""
    names = [f"{number}. {said(row['label'])}" for number, row in enumerate(rows, start=1)]
    sizes = [13 if row["current"] else 8 for row in rows]
    noise = next((row["noise_sd_nm"] for row in reversed(rows) if row.get("noise_sd_nm")), None)
    held = [row["held_out_rms_nm"] for row in rows]
    data = [line(names, [row["rms_nm"] for row in rows], "rows used to fit", MEASURED, 2.0,
                 mode="lines+markers", marker={"size": sizes})]  # fmt: skip
    if any(value is not None for value in held):
        data.append(line(names, held, "rows not used to fit", MODEL, 2.6, mode="lines+markers", marker={"size": sizes}))
    shapes, labels = [], []
    if noise:
        shapes.append({"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": noise, "y1": noise,
                       "line": {"color": STIMULUS, "width": 1.6, "dash": "dash"}})  # fmt: skip
        labels.append({"xref": "paper", "x": 0, "y": noise, "text": f"noise {noise:.3f} N·m", "showarrow": False,
                       "yanchor": "bottom", "xanchor": "left", "name": "noise",
                       "font": {"color": STIMULUS}})  # fmt: skip
    x = axis("", type="category", range=[-0.4, len(rows) - 0.6])
    y = axis("Error, rms (N·m)", rangemode="tozero")
    return {"data": data, "layout": layout(height=320, shapes=shapes, annotations=labels, xaxis=x, yaxis=y)}


def of_why(
    comparison: dict[str, Any] | None,
    segments: list[dict[str, Any]],
    view: dict[str, Any] | None,
    signatures: dict[str, Any],
    rows: list[dict[str, Any]],
) -> dict[str, Any]:
    """All figures of the section by name."""
    figures = {"falling": falling(rows)} if len(rows) > 1 else {}
    if comparison and comparison.get("series"):
        figures["residual"] = residual(comparison, segments, view["places"] if view else places_of(comparison))
    for entry in view["missing"] if view else []:
        if entry["id"] in signatures:
            figures[f"signature-{entry['id']}"] = signature(signatures["time_s"], signatures[entry["id"]])
    return figures


def places_of(comparison: dict[str, Any]) -> list[dict[str, Any]]:
    """The worst places before a diagnosis is there."""
    from api.models.explanation import place

    return [place(entry, number) for number, entry in enumerate(comparison.get("where") or [], start=1)]

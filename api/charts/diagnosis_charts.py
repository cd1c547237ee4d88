"""Figures of what is missing: the residual with its worst places, signatures, the falling error."""

from __future__ import annotations

from typing import Any

from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import INK, MEASURED, MODEL, TOOLBAR_PX, axis, box, line, role
from stimrig.api.charts.model_charts import segment_marks
from stimrig.api.models import explanation
from stimrig.identify.healing import looks_like_noise
from stimrig.identify.yardstick import floor_nm

MARK, MARK_LINE, FLOOR = role("worst-band"), role("worst"), role("limit")
EDGES = ("lower", "upper")
NAMED_LETTERS = 60
"""Letters of the versions' names up to which they stand below their chart on a tablet."""


def diagnosis_figures(
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
    return figures | pictures(view["free"] if view else [])


def pictures(entries: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of free effects, by name."""
    return {f"free-{entry['id']}": picture(entry) for entry in entries}


def places_of(comparison: dict[str, Any]) -> list[dict[str, Any]]:
    """The worst places before a diagnosis is there."""
    if looks_like_noise(comparison):
        return []
    return [explanation.place(entry, number) for number, entry in enumerate(comparison.get("where") or [], start=1)]


def residual(
    comparison: dict[str, Any], segments: list[dict[str, Any]], places: list[dict[str, Any]]
) -> dict[str, Any]:
    """Measurement minus model over time, the noise band, the worst places marked with their numbers."""
    series = comparison["series"]
    time_s, noise_nm = series["time_s"], series.get("noise_band_nm") or 0.0
    shapes, labels = segment_marks(segments)
    shapes.append(box(time_s[0], time_s[-1], fig.NOISE, -noise_nm, noise_nm, yref="y"))
    for place in places:
        shapes.append(box(place["start_s"], place["end_s"], MARK))
        labels.append(number_place(place))
    words = "measured − model"
    said = fig.hover(words, fig.RESIDUAL + fig.BESIDE, fig.name_segments(time_s, segments))
    return fig.figure(
        [line(time_s, series["residual_nm"], words, INK, 0.9, **said)],
        height=320, shapes=shapes, annotations=labels, showlegend=False,
        margin={"l": 64, "r": TOOLBAR_PX, "t": 30, "b": 48},
        xaxis=axis("Time (s)", range=[time_s[0], time_s[-1]], **fig.AT_TIME),
        yaxis=axis("Measured − model (N·m)"),
    )  # fmt: skip


def number_place(place: dict[str, Any]) -> dict[str, Any]:
    """The number of a place, at its top."""
    return {
        "xref": "x", "yref": "paper", "x": (place["start_s"] + place["end_s"]) / 2, "y": 0.985, "yanchor": "top",
        "text": f"<b>{place['number']}</b>", "showarrow": False, "font": {"size": 12, "color": role("on-worst")},
        "bgcolor": role("good") if place.get("healed") else MARK_LINE, "borderpad": 3, "name": "place",
    }  # fmt: skip


def signature(time_s: list[float], found: dict[str, list[float]]) -> dict[str, Any]:
    """What is left without an effect, and what adding it explains of that."""
    seen, expected = (fig.hover(words, fig.RESIDUAL) for words in ("seen", "expected"))
    data = [
        line(time_s, found["seen_nm"], "seen: left without it", MEASURED, 3.2, **seen),
        line(time_s, found["expected_nm"], "expected: what it explains", MODEL, 1.8, **expected),
    ]
    x = axis("Time (s)", range=[time_s[0], time_s[-1]], **fig.AT_TIME)
    margin = {"l": 56, "r": TOOLBAR_PX, "t": 30, "b": 42}
    return fig.figure(data, height=250, xaxis=x, yaxis=axis("Torque (N·m)"), margin=margin)


def picture(found: dict[str, Any]) -> dict[str, Any]:
    """What a free effect does: its curves, each with its band."""
    data = []
    for number, (name, own) in enumerate(found["lines"].items()):
        colour, words = (MODEL, MEASURED)[number % 2], fig.unlinked(name)
        data += fig.filled(found["at"], own["lower"], own["upper"], "95 % band") if number == 0 else []
        if number:
            edges = (line(found["at"], own[edge], "", colour, 0.8, showlegend=False, **fig.QUIET) for edge in EDGES)
            data += edges
        data.append(line(found["at"], own["value"], words, colour, 2.2, **fig.hover(words, fig.SHARE)))
    margin = {"l": 64, "r": TOOLBAR_PX, "t": 30, "b": 48}
    x, y = (axis(fig.unlinked(found[key])) for key in ("driver", "axis"))
    return fig.figure(data, height=270, xaxis=x, yaxis=y, margin=margin)


def falling(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Error over the versions, with the noise as the line to fall to."""
    names = [f"{number}. {fig.unlinked(row['label'])}" for number, row in enumerate(rows, start=1)]
    sizes = [13 if row["current"] else 8 for row in rows]
    data = []
    for key, words, colour, symbol in (
        ("rms_nm", "fitted pulses", MEASURED, "circle"),
        ("held_out_rms_nm", "held-out pulses", MODEL, "diamond"),
    ):
        values, marker = [row[key] for row in rows], {"size": sizes, "symbol": symbol, "color": colour}
        if key == "rms_nm" or any(value is not None for value in values):
            said = fig.hover(words, "%{y:.3f} N·m")
            data.append(line(names, values, words, colour, 2.2, mode="lines+markers", marker=marker, **said))
    shapes, labels = [], []
    repeats = rows[-1].get("repetition") or {}
    between = "scatter at rest" if repeats.get("found_by") == "estimate" else "between repeats"
    floors = ((rows[-1].get("noise_sd_nm"), "noise", "noise", "left"),
              (floor_nm(repeats), "repetition", between, "right"))  # fmt: skip
    for level_nm, name, words, side in floors:
        if level_nm:
            shapes.append({"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": level_nm, "y1": level_nm,
                           "line": {"color": FLOOR, "width": 1.6, "dash": "dash"}})  # fmt: skip
            labels.append({"xref": "paper", "x": 0 if side == "left" else 1, "y": level_nm, "showarrow": False,
                           "text": f"{words} {level_nm:.3f} N·m", "yanchor": "bottom",
                           "xanchor": side, "name": name, "font": {"color": FLOOR}})  # fmt: skip
    x = axis("", type="category", range=[-0.4, len(rows) - 0.6])
    if sum(map(len, names)) > NAMED_LETTERS:  # they would be cut off; the table below names each number
        x |= {"tickvals": names, "ticktext": [f"{number}." for number in range(1, len(rows) + 1)]}
    y = axis("Error (N·m)", rangemode="tozero")
    return fig.figure(data, height=320, shapes=shapes, annotations=labels, xaxis=x, yaxis=y)

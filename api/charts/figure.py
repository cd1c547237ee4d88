"""Figures as plotly takes them (`data` and `layout`), with colours by role: `var(--role)` of `page.css`.

A page hands them to plotly as they are; `drawing.py` draws the same ones by matplotlib.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stimrig.api.clinical_words import segment_words

SHEET = Path(__file__).parents[1] / "web" / "pages" / "static" / "page.css"
CONFIG: dict[str, Any] = {
    "responsive": True,
    "displaylogo": False,
    "showSendToCloud": False,
    "plotlyServerURL": "",
    "modeBarButtons": [["toImage"], ["zoom2d", "pan2d", "resetScale2d"]],
    "displayModeBar": True,
}
"""plotly's own set of buttons offers to upload the chart, with a person's torque in it, to its maker's cloud: buttons
are named one by one, so that later versions' stay away, too."""
TOOLBAR_PX = 42
"""On the right of a chart: the buttons stand there one below the other and cover no line."""
GAP_PX = 30
TORQUE, RESIDUAL, WIDTH = "%{y:.2f} N·m", "%{y:+.3f} N·m", "%{y:.0f} µs"
ERROR, SHARE, FACTOR = "%{y:.3f} N·m", "%{y:.3f}", "%{y:.2f}"
"""Format of a value in the tooltip."""
Figure = dict[str, Any]


def _read_light() -> dict[str, str]:
    """Read the light colours of `page.css` by role; a role that refers to another one has that one's colour."""
    sheet = SHEET.read_text("utf-8")
    values = re.findall(r"--([\w-]+): ([^;]+);", sheet[: sheet.index("\n}")])
    colours = {name: value.removeprefix("light-dark(").partition(", ")[0] for name, value in values}
    return {name: colours.get(value.removeprefix("var(--").rstrip(")"), value) for name, value in colours.items()}


LIGHT = _read_light()


def variable(role: str) -> str:
    """Return the CSS variable of a colour's role."""
    return f"var(--{role})"


def in_light(figure: Figure) -> Figure:
    """Return a figure with the light colours in place of roles, for where no style sheet is."""
    return json.loads(re.sub(r'"var\(--([\w-]+)\)"', lambda role: f'"{LIGHT[role[1]]}"', json.dumps(figure)))


def text(words: str) -> str:
    """Keep plotly from making a link of `<a href=…>` in words of a recording or of a user's own effect."""
    return words.replace("<", "‹").replace(">", "›").replace("var(--", "var( --")


def figure(
    x: dict[str, Any], panels: Sequence[dict[str, Any]], traces: Sequence[dict[str, Any]],
    shapes: Sequence[dict[str, Any]] = (), names: Sequence[dict[str, Any]] = (), height: float = 340.0,
    shares: Sequence[float] = (1.0,),
) -> Figure:  # fmt: skip
    """Put a figure of some `height` (px) together: panels one above another, with `shares` of it, over one x axis.

    `traces`: of `curve` and `band`; `shapes`: of `shade`, `level` and `rule`; `names`: of `name` and `badge`.
    """
    legend, above = sum(trace["showlegend"] for trace in traces) > 1, 18 if names else 0
    top = (30 if legend else 10) + above
    plot_px = height - top - 48
    layout: dict[str, Any] = {
        "height": height,
        "font": {"family": "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif", "size": 13,
                 "color": variable("ink")},
        "paper_bgcolor": variable("chart"),
        "plot_bgcolor": variable("chart"),
        "margin": {"l": 64, "r": TOOLBAR_PX, "t": top, "b": 48},
        "showlegend": legend,
        "legend": {"orientation": "h", "x": 0, "y": 1 + above / plot_px, "yanchor": "bottom", "traceorder": "normal"},
        "modebar": {"orientation": "v", "bgcolor": "rgba(0,0,0,0)", "color": variable("dim"),
                    "activecolor": variable("accent")},
        "hovermode": "x unified",
        "hoversubplots": "axis",
        "hoverlabel": {"bgcolor": variable("card"), "bordercolor": variable("line"),
                       "font": {"color": variable("ink")}},
        "uirevision": "kept",
        "separators": ". ",
        "shapes": list(shapes),
        "annotations": list(names),
        "xaxis": {**x, "anchor": _axis_id("y", len(panels) - 1)},
    }  # fmt: skip
    gap, high = GAP_PX / plot_px, 1.0
    free = (1 - gap * (len(panels) - 1)) / sum(shares)
    for number, (panel, share) in enumerate(zip(panels, shares, strict=True)):
        low = max(high - free * share, 0.0)
        layout[_axis_id("yaxis", number)] = {**panel, "domain": [low, high]}
        high = low - gap
    return {"data": list(traces), "layout": layout}


def _axis_id(letter: str, number: int) -> str:
    return f"{letter}{number + 1}" if number else letter


def axis(
    label: str, hover: str = "", limits: tuple[float, float] | None = None, ticks: Sequence[tuple[float, str]] = (),
    from_zero: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Return an axis: quantity with its unit; `ticks` stand in place of numbers."""
    settings: dict[str, Any] = {
        "title": {"text": text(label), "standoff": 8, "font": {"size": 12}},
        "gridcolor": variable("grid"), "zerolinecolor": variable("zero"), "automargin": True,
    }  # fmt: skip
    if hover:
        settings["unifiedhovertitle"] = {"text": hover}
    if limits:
        settings["range"] = list(limits)
    if from_zero:
        settings["rangemode"] = "tozero"
    if ticks:
        settings |= {"tickvals": [at for at, _ in ticks], "ticktext": [text(words) for _, words in ticks]}
    return settings


def time_axis(start_s: float, end_s: float) -> dict[str, Any]:
    """Return the axis of time."""
    return axis("Time (s)", "%{x:.2f} s", (start_s, end_s))


def curve(
    x: Sequence[float], y: Sequence[float | None], label: str, colour: str, width: float = 1.6, *, dash: str = "solid",
    step: bool = False, panel: int = 0, marker: str = "", size: float = 8, hollow: bool = False, most_markers: int = 0,
    hover: str = "", notes: Sequence[str] = (), listed: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """Return points joined by a line, which None breaks; without `width` only markers are drawn.

    Without `hover` the pointer shows no value; `notes` stand behind the values, one for each point.
    """
    mode = [name for name, there in (("lines", width), ("markers", marker)) if there]
    trace: dict[str, Any] = {
        "type": "scatter", "mode": "+".join(mode), "x": list(x), "y": list(y), "name": text(label),
        "line": {"color": variable(colour), "width": width, "dash": dash, "shape": "hv" if step else "linear"},
        "yaxis": _axis_id("y", panel), "showlegend": listed and bool(label),
    }  # fmt: skip
    if marker:
        trace["marker"] = {
            "symbol": marker, "size": size, "maxdisplayed": most_markers,
            "color": variable("chart" if hollow else colour),
            "line": {"color": variable(colour), "width": 1.8 if hollow else 0},
        }  # fmt: skip
    if not hover:
        return trace | {"hoverinfo": "skip"}
    template = f"{text(label)} {hover}"
    if notes:
        trace["customdata"], template = [text(note) for note in notes], template + " %{customdata}"
    return trace | {"hovertemplate": template + "<extra></extra>"}


def band(
    x: Sequence[float], lower: Sequence[float], upper: Sequence[float], label: str = "95 % band",
    colour: str = "model-band", listed: bool = True,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the area between two curves of the first panel."""
    edge = curve(x, upper, "", colour, 0, listed=False) | {"mode": "lines"}
    fill = {"fill": "tonexty", "fillcolor": variable(colour), "name": text(label), "showlegend": listed}
    return [edge, {**edge, "y": list(lower), **fill}]


def _over_all_panels(start: float, end: float) -> dict[str, Any]:
    return {"xref": "x", "yref": "paper", "x0": start, "x1": end, "y0": 0, "y1": 1}


def _over_all_x(low: float, high: float, panel: int) -> dict[str, Any]:
    return {"xref": "paper", "yref": _axis_id("y", panel), "x0": 0, "x1": 1, "y0": low, "y1": high}


def shade(colour: str, start: float, end: float) -> dict[str, Any]:
    """Return a stretch of x over all panels."""
    style = {"fillcolor": variable(colour), "line": {"width": 0}, "layer": "below"}
    return {"type": "rect", **_over_all_panels(start, end), **style}


def level(colour: str, low: float, high: float, panel: int = 0) -> dict[str, Any]:
    """Return a range of one panel's values over all x."""
    return {**shade(colour, 0, 1), **_over_all_x(low, high, panel)}


def rule(at: float, words: str = "", colour: str = "limit", *, upright: bool = False, right: bool = False) -> Figure:
    """Return a dashed line at a value of the first panel, or upright at a place on the x axis, with its words."""
    place, position = _over_all_panels(at, at) if upright else _over_all_x(at, at, 0), "end" if right else "start"
    label = {"text": text(words), "font": {"color": variable(colour)}, "textposition": position, "yanchor": "bottom",
             "textangle": 0}  # fmt: skip
    return {"type": "line", **place, "line": {"color": variable(colour), "width": 1.6, "dash": "dash"}, "label": label}


def name(x: float, words: str) -> dict[str, Any]:
    """Return a name above the panels."""
    return {"xref": "x", "yref": "paper", "x": x, "y": 1.0, "yanchor": "bottom", "showarrow": False,
            "text": text(words), "font": {"size": 12, "color": variable("mark")}}  # fmt: skip


def badge(x: float, words: str, colour: str) -> dict[str, Any]:
    """Return a number at the top of the panels, on a ground of this colour."""
    style = {"bgcolor": variable(colour), "borderpad": 3, "font": {"size": 12, "color": variable("on-worst")}}
    return {**name(x, words), "y": 0.985, "yanchor": "top", "name": "place", **style}


# ---- what MODEL.json and recordings give ---------------------------------------------------------------------------


def band_of(document: dict[str, Any], curve_name: str, along: str, **options: Any) -> list[dict[str, Any]]:
    """Return a curve's band in MODEL.json; nothing where the method gives none."""
    known = ((document.get("uncertainty") or {}).get("bands") or {}).get(curve_name)
    return band(known[along], known["whole_lower"], known["whole_upper"], **options) if known else []


def half_widths(area: list[dict[str, Any]], x: Sequence[float]) -> list[str]:
    """Return the half width of a band at each x, as text."""
    import numpy as np

    if not area:
        return []
    upper, lower = (np.asarray(edge["y"], dtype=float) for edge in area)
    return [f"± {half:.2f}" for half in np.interp(x, area[0]["x"], (upper - lower) / 2)]


def segment_names(time_s: Sequence[float], segments: Sequence[dict[str, Any]]) -> list[str]:
    """Return the name of the segment at each time."""
    names, number = [], 0
    for moment_s in time_s:
        while number < len(segments) - 1 and moment_s >= segments[number + 1]["start_s"]:
            number += 1
        names.append(f"· {segment_words(segments[number]['name'])}" if segments else "")
    return names

"""Figures as plotly takes them: in a page where somebody looks closer, and in notebooks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stimrig.api.charts.figure import Axis, Band, Curve, Figure, Value, variable

BUTTONS = {
    "Download plot as a PNG": "Save as a picture",
    "Download plot": "Save as a picture",
    "Zoom": "Zoom: draw a box",
    "Pan": "Move",
    "Reset axes": "Show all again",
}
CHART_CONFIG: dict[str, Any] = {
    "responsive": True,
    "displaylogo": False,
    "showSendToCloud": False,
    "plotlyServerURL": "",
    "modeBarButtons": [["toImage"], ["zoom2d", "pan2d", "resetScale2d"]],
    "displayModeBar": True,
}
"""plotly's own set of buttons offers to upload the chart, with a person's torque in it, to its maker's cloud: buttons
are named one by one, so that later versions' stay away, too."""
PAGE_CONFIG: dict[str, Any] = {
    **CHART_CONFIG, "locale": "page", "locales": {"page": {"format": {}, "dictionary": BUTTONS}},
}  # fmt: skip
TOOLBAR_PX = 42
"""On the right of a chart: the buttons stand there one below the other and cover no line."""
GAP_PX = 30
FONT = "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif"
SYMBOLS = {"up": "triangle-up", "down": "triangle-down"}
QUIET = {"hoverinfo": "skip"}

Colour = Callable[[str], str]


def plotly_figure(figure: Figure, colour: Colour = variable) -> dict[str, Any]:
    """Return ``data`` and ``layout`` for plotly; `colour` gives the colour of a role."""
    top = (30 if figure.entries() else 10) + (18 if figure.labels else 0)
    plot_px = figure.height - top - 48
    data = [trace for band in figure.bands for trace in _band(band, colour)]
    data += [_curve(curve, colour) for curve in figure.curves]
    layout: dict[str, Any] = {
        "height": figure.height,
        "font": {"family": FONT, "size": 13, "color": colour("ink")},
        "paper_bgcolor": colour("chart"),
        "plot_bgcolor": colour("chart"),
        "margin": {"l": 64, "r": TOOLBAR_PX, "t": top, "b": 48},
        "showlegend": bool(figure.entries()),
        "legend": {"orientation": "h", "x": 0, "y": 1 + (18 if figure.labels else 0) / plot_px, "yanchor": "bottom",
                   "traceorder": "normal"},
        "modebar": {"orientation": "v", "bgcolor": "rgba(0,0,0,0)", "color": colour("dim"),
                    "activecolor": colour("accent")},
        "hovermode": "x unified",
        "hoversubplots": "axis",
        "hoverlabel": {"bgcolor": colour("card"), "bordercolor": colour("line"), "font": {"color": colour("ink")}},
        "uirevision": "kept",
        "shapes": _shapes(figure, colour),
        "annotations": _annotations(figure, colour),
        "xaxis": {**_axis(figure.x, colour), "anchor": _axis_id("y", len(figure.panels) - 1)},
    }  # fmt: skip
    if figure.x.value:
        layout["xaxis"]["unifiedhovertitle"] = {"text": _value("x", figure.x.value)}
    gap, high = GAP_PX / plot_px, 1.0
    free = (1 - gap * (len(figure.panels) - 1)) / sum(panel.share for panel in figure.panels)
    for number, panel in enumerate(figure.panels):
        low = max(high - free * panel.share, 0.0)
        layout["yaxis" + _axis_id("", number)] = {**_axis(panel, colour), "domain": [low, high]}
        high = low - gap
    return {"data": data, "layout": layout}


def page_figure(figure: Figure, file_name: str) -> dict[str, Any]:
    """Return a figure with what a page's script passes on to plotly; `file_name`: of a picture that is saved."""
    content = plotly_figure(figure)
    content["layout"]["separators"] = ". "
    return {**content, "config": {**PAGE_CONFIG, "toImageButtonOptions": {"filename": file_name, "scale": 2}}}


def _axis_id(letter: str, number: int) -> str:
    return f"{letter}{number + 1}" if number else letter


def _text(words: str) -> str:
    """Keep plotly from making a link of `<a href=…>` in words of a recording or of a user's own effect."""
    return words.replace("<", "‹").replace(">", "›")


def _value(letter: str, value: Value) -> str:
    return f"%{{{letter}:{'+' if value.signed else ''}.{value.digits}f}}{value.unit}"


def _axis(axis: Axis, colour: Colour) -> dict[str, Any]:
    title = {"text": _text(axis.label), "standoff": 8, "font": {"size": 12}}
    settings: dict[str, Any] = {
        "title": title, "gridcolor": colour("grid"), "zerolinecolor": colour("zero"), "automargin": True,
    }  # fmt: skip
    if axis.limits:
        settings["range"] = list(axis.limits)
    if axis.from_zero:
        settings["rangemode"] = "tozero"
    if axis.ticks:
        settings |= {"tickvals": [at for at, _ in axis.ticks], "ticktext": [_text(words) for _, words in axis.ticks]}
    return settings


def _curve(curve: Curve, colour: Colour) -> dict[str, Any]:
    line = {"color": colour(curve.colour), "width": curve.width, "dash": curve.dash}
    mode = [name for name, there in (("lines", curve.width), ("markers", curve.marker)) if there]
    trace: dict[str, Any] = {
        "type": "scatter", "mode": "+".join(mode), "x": list(curve.x), "y": list(curve.y), "name": _text(curve.label),
        "line": {**line, "shape": "hv"} if curve.step else line, "yaxis": _axis_id("y", curve.panel),
        "showlegend": curve.listed,
    }  # fmt: skip
    if curve.marker:
        trace["marker"] = {
            "symbol": SYMBOLS.get(curve.marker, curve.marker),
            "size": [0 if number % curve.every else curve.size for number in range(len(curve.x))],
            "color": colour("chart" if curve.hollow else curve.colour),
            "line": {"color": colour(curve.colour), "width": 1.8 if curve.hollow else 0},
        }
    if curve.value is None:
        return trace | QUIET
    template = f"{_text(curve.label)} {_value('y', curve.value)}"
    if curve.notes:
        trace["customdata"], template = [_text(note) for note in curve.notes], template + " %{customdata}"
    return trace | {"hovertemplate": template + "<extra></extra>"}


def _band(band: Band, colour: Colour) -> list[dict[str, Any]]:
    edge: dict[str, Any] = {
        "type": "scatter", "mode": "lines", "name": "", "x": list(band.x), "line": {"width": 0}, **QUIET,
        "yaxis": _axis_id("y", band.panel), "showlegend": False,
    }  # fmt: skip
    fill = {"fill": "tonexty", "fillcolor": colour(band.colour), "name": _text(band.label), "showlegend": band.listed}
    return [{**edge, "y": list(band.upper)}, {**edge, "y": list(band.lower), **fill}]


def _shapes(figure: Figure, colour: Colour) -> list[dict[str, Any]]:
    shapes: list[dict[str, Any]] = []
    for shade in figure.shades:
        place = {"xref": "x", "yref": "paper", "x0": shade.start, "x1": shade.end, "y0": 0, "y1": 1}
        if shade.low is not None:
            yref = _axis_id("y", shade.panel)
            place = {"xref": "paper", "yref": yref, "x0": 0, "x1": 1, "y0": shade.low, "y1": shade.high}
        style = {"fillcolor": colour(shade.colour), "line": {"width": 0}, "layer": "below"}
        shapes.append({"type": "rect", **place, **style})
    for rule in figure.rules:
        place = {"xref": "paper", "yref": "y", "x0": 0, "x1": 1, "y0": rule.at, "y1": rule.at}
        if rule.vertical:
            place = {"xref": "x", "yref": "paper", "x0": rule.at, "x1": rule.at, "y0": 0, "y1": 1}
        shapes.append({"type": "line", **place, "line": {"color": colour(rule.colour), "width": 1.6, "dash": "dash"}})
    return shapes


def _annotations(figure: Figure, colour: Colour) -> list[dict[str, Any]]:
    notes: list[dict[str, Any]] = []
    for label in figure.labels:
        note: dict[str, Any] = {"xref": "x", "yref": "paper", "x": label.x, "showarrow": False}
        if label.badge:
            note |= {"y": 0.985, "yanchor": "top", "text": f"<b>{_text(label.text)}</b>", "name": "place",
                     "bgcolor": colour(label.badge), "borderpad": 3,
                     "font": {"size": 12, "color": colour("on-worst")}}  # fmt: skip
        else:
            note |= {"y": 1.0, "yanchor": "bottom", "text": _text(label.text),
                     "font": {"size": 12, "color": colour("mark")}}  # fmt: skip
        notes.append(note)
    for rule in figure.rules:
        if not rule.text:
            continue
        place = {"xref": "paper", "yref": "y", "x": float(rule.right), "xanchor": "right" if rule.right else "left",
                 "y": rule.at, "yanchor": "bottom"}  # fmt: skip
        if rule.vertical:
            place = {"xref": "x", "yref": "paper", "x": rule.at, "xanchor": "left", "y": 0.42}
        style = {"showarrow": False, "font": {"color": colour(rule.colour)}, "name": "rule"}
        notes.append({**place, **style, "text": _text(rule.text)})
    return notes

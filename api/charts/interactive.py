"""A figure as plotly takes it, for looking closer in a page: zoom, and values under the pointer.

Colours stay roles, `var(--role)`: the page puts those of its style sheet in their place. plotly's own set of buttons
offers to upload a chart, with a person's torque in it, to its maker: buttons are named one by one.
"""

from __future__ import annotations

from typing import Any

from stimrig.api.charts.figure import Axis, Band, Figure, Figures, Line, Note, Rule, Shade

GAP = 0.08
"""Share of the height between two panels."""
SYMBOLS = {"o": "circle", "s": "square", "D": "diamond", "^": "triangle-up", "v": "triangle-down", "x": "x"}
WORDS = {"Download plot as a PNG": "Save as a picture", "Download plot": "Save as a picture",
         "Zoom": "Zoom: draw a box", "Pan": "Move", "Reset axes": "Show all again"}  # fmt: skip
"""plotly's words for its buttons, and those of the page."""
CONFIG: dict[str, Any] = {
    "responsive": True, "displaylogo": False, "displayModeBar": True, "showSendToCloud": False, "plotlyServerURL": "",
    "modeBarButtons": [["toImage"], ["zoom2d", "pan2d", "resetScale2d"]],
    "locale": "page", "locales": {"page": {"format": {}, "dictionary": WORDS}},
}  # fmt: skip


NOTE_PX, BOTTOM_PX = 18, 48
"""Height of a line of notes above the plot, and of what stands below it."""


def for_plotly(figure: Figure, file_name: str) -> dict[str, Any]:
    """Return `data`, `layout` and `config`; a picture that is saved gets the file name."""
    data, shapes, notes = [], [], []
    for mark in figure.marks:
        match mark:
            case Line():
                data.append(_line(mark, figure))
            case Band(x=x, lower=lower, upper=upper, label=label):
                data.append({
                    "type": "scatter", "x": [*x, *reversed(x)], "y": [*upper, *reversed(lower)], "fill": "toself",
                    "mode": "lines", "line": {"width": 0}, "fillcolor": _colour(mark.colour), "name": _text(label),
                    "showlegend": mark.listed and bool(label), "hoverinfo": "skip",
                })  # fmt: skip
            case Shade(start=start, end=end, panel=panel):
                place = _over_panels(start, end) if panel is None else _over_x(start, end, panel)
                fill = {"fillcolor": _colour(mark.colour), "line": {"width": 0}, "layer": "below"}
                shapes.append({"type": "rect", **place, **fill})
            case Rule(at=at):
                place = _over_panels(at, at) if mark.upright else _over_x(at, at, 0)
                label = {
                    "text": _text(mark.words), "textangle": 0, "yanchor": "bottom",
                    "textposition": "end" if mark.right else "start", "font": {"color": _colour(mark.colour)},
                }  # fmt: skip
                line = {"color": _colour(mark.colour), "width": 1.4, "dash": "dash"}
                shapes.append({"type": "line", **place, "line": line, "label": label})
            case Note(ground=ground):
                note = {"xref": "x", "yref": "paper", "x": mark.x, "y": 1.0, "showarrow": False,
                        "text": _text(mark.words), "yanchor": "top" if ground else "bottom",
                        "font": {"color": _colour("on-worst" if ground else "mark")}}  # fmt: skip
                notes.append(note | ({"bgcolor": _colour(ground), "borderpad": 3, "name": "place"} if ground else {}))
    legend = sum(trace["showlegend"] for trace in data) > 1
    notes_px = NOTE_PX if any("bgcolor" not in note for note in notes) else 0  # between the plot and its legend
    top_px = notes_px + (34 if legend else 14)
    inner_px = figure.height - top_px - BOTTOM_PX
    layout = {
        "height": figure.height, "showlegend": legend, "shapes": shapes, "annotations": notes,
        "margin": {"l": 64, "r": Figures.TOOLS_PX, "t": top_px, "b": BOTTOM_PX},
        "legend": {"orientation": "h", "x": 0, "y": 1.0 + (notes_px + 4) / inner_px, "yanchor": "bottom",
                   "traceorder": "normal"},
        "font": {"family": "system-ui, 'DejaVu Sans', sans-serif", "size": 13, "color": _colour("ink")},
        "paper_bgcolor": _colour("chart"), "plot_bgcolor": _colour("chart"),
        "modebar": {"orientation": "v", "bgcolor": "rgba(0,0,0,0)", "color": _colour("dim"),
                    "activecolor": _colour("accent")},
        "hovermode": "x unified", "hoversubplots": "axis",
        "hoverlabel": {"bgcolor": _colour("card"), "font": {"color": _colour("ink")}},
        "uirevision": "kept", "separators": ". ",
        "xaxis": {**_axis(figure.x), "anchor": _name("y", len(figure.panels) - 1)},
    }  # fmt: skip
    high, free = 1.0, (1.0 - GAP * (len(figure.panels) - 1)) / sum(figure.shares)
    for number, (panel, share) in enumerate(zip(figure.panels, figure.shares, strict=True)):
        low = max(high - free * share, 0.0)
        layout[_name("yaxis", number)] = {**_axis(panel), "domain": [low, high]}
        high = low - GAP
    return {"data": data, "layout": layout, "config": CONFIG | {"toImageButtonOptions": {"filename": file_name}}}


def _line(mark: Line, figure: Figure) -> dict[str, Any]:
    colour, unit = _colour(mark.colour), figure.panels[mark.panel].label.rpartition("(")[2].rstrip(")")
    modes = [mode for mode, there in (("lines", mark.width), ("markers", mark.marker)) if there]
    shape = {"width": mark.width, "dash": mark.dash, "shape": "hv" if mark.step else "linear"}
    trace = {
        "type": "scatter", "mode": "+".join(modes), "x": [*mark.x], "y": [*mark.y], "yaxis": _name("y", mark.panel),
        "name": _text(mark.label), "showlegend": mark.listed and bool(mark.label), "line": {"color": colour, **shape},
        "hovertemplate": f"{_text(mark.label)} %{{y:.4~g}} {_text(unit)}<extra></extra>",
    }  # fmt: skip
    if mark.marker:
        symbol = SYMBOLS.get(mark.marker, "circle")
        trace["marker"] = {"symbol": symbol, "size": mark.size, "maxdisplayed": mark.most_markers, "color": colour}
    return trace if mark.label else trace | {"hovertemplate": None, "hoverinfo": "skip"}


def _axis(axis: Axis) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "title": {"text": _text(axis.label), "standoff": 8, "font": {"size": 12}}, "automargin": True,
        "gridcolor": _colour("grid"), "zerolinecolor": _colour("zero"),
    }  # fmt: skip
    if axis.limits:
        settings["range"] = [*axis.limits]
    if axis.from_zero:
        settings["rangemode"] = "tozero"
    if axis.ticks:
        settings |= {"tickvals": [at for at, _ in axis.ticks], "ticktext": [_text(words) for _, words in axis.ticks]}
    return settings


def _over_panels(start: float, end: float) -> dict[str, Any]:
    return {"xref": "x", "yref": "paper", "x0": start, "x1": end, "y0": 0, "y1": 1}


def _over_x(low: float, high: float, panel: int) -> dict[str, Any]:
    return {"xref": "paper", "yref": _name("y", panel), "x0": 0, "x1": 1, "y0": low, "y1": high}


def _name(axis: str, number: int) -> str:
    return f"{axis}{number + 1}" if number else axis


def _colour(role: str) -> str:
    return f"var(--{role})"


def _text(words: str) -> str:
    """Keep plotly from making a link of `<a href=…>` in words of a recording or of a user's own effect."""
    return words.lstrip("_").replace("<", "‹").replace(">", "›").replace("var(--", "var( --")

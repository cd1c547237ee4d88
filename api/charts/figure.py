"""What all figures are made of: colours by what a line means, axes, lines, shades, words under the pointer.

A figure holds `var(--name)`: a page's stills take the value from the style sheet, its scripts look it up when they
draw, and what has no style sheet (a notebook, a printed sheet) takes `LIGHT`. `tests/api/test_colours.py`
computes their contrast.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stimrig.api.clinical_words import segment_words

SHEET = Path(__file__).parents[1] / "web" / "pages" / "static" / "page.css"
NAMED = re.compile(r"var\(--([\w-]+)\)")
PAINTED = re.compile(r'(fill|stroke)="var\(--([\w-]+)\)"')


def _light() -> dict[str, str]:
    """The values that `page.css` gives to its names; a name for another colour has that one's."""
    sheet = SHEET.read_text("utf-8")
    found = dict(re.findall(r"--([\w-]+): ([^;]+);", sheet[: sheet.index("\n}")]))
    return {name: found.get(value.removeprefix("var(--").rstrip(")"), value) for name, value in found.items()}


LIGHT = _light()


def role(name: str) -> str:
    """A colour by its role, for a page."""
    assert name in LIGHT, name
    return f"var(--{name})"


def in_light(part: Any) -> Any:
    """A figure with the light colours in it."""
    if isinstance(part, dict):
        return {key: in_light(value) for key, value in part.items()}
    if isinstance(part, list):
        return [in_light(value) for value in part] if part and not isinstance(part[0], float | int) else part
    named = NAMED.fullmatch(part) if isinstance(part, str) else None
    return LIGHT[named[1]] if named else part


def paint_light(picture: str) -> str:
    """A still with the light colours in it; its words are left alone. SVG 1.1 has a colour and its opacity apart."""
    return PAINTED.sub(lambda found: _painted(found[1], LIGHT[found[2]]), picture)


def _painted(attribute: str, colour: str) -> str:
    if not colour.startswith("rgba("):
        return f'{attribute}="{colour}"'
    red, green, blue, opacity = colour.removeprefix("rgba(").rstrip(")").split(",")
    return f'{attribute}="rgb({red},{green},{blue})" {attribute}-opacity="{opacity}"'


# ---- what every chart may do ------------------------------------------------------------------------------------

CHART_CONFIG: dict[str, Any] = {
    "responsive": True,
    "displaylogo": False,
    "showSendToCloud": False,
    "plotlyServerURL": "",
    "modeBarButtons": [["toImage"], ["zoom2d", "pan2d", "resetScale2d"]],
    "displayModeBar": True,
}
"""Look closer, and save a picture on this machine. The plot library's own set of buttons offers to upload the chart,
with a person's torque in it, to its maker's cloud: buttons are named one by one, and later versions' stay away, too."""
BUTTONS = {
    "Download plot as a PNG": "Save as a picture",
    "Download plot": "Save as a picture",
    "Zoom": "Zoom: draw a box",
    "Pan": "Move",
    "Reset axes": "Show all again",
}
PAGE_CONFIG: dict[str, Any] = {
    **CHART_CONFIG, "locale": "page", "locales": {"page": {"format": {}, "dictionary": BUTTONS}},
}  # fmt: skip
"""On a page: the buttons' words."""


def unlinked(words: str) -> str:
    """Words of a recording or of a user's own effect, for a chart: `<a href=…>` would become a link there."""
    return words.replace("<", "‹").replace(">", "›")


def segment_name(name: str) -> str:
    """What a person calls a segment, for a chart."""
    return unlinked(segment_words(name))


# ---- axes, lines, shades ----------------------------------------------------------------------------------------

INK, MEASURED, MODEL, STIMULUS, FAINT = (role(name) for name in ("residual", "measured", "model", "width", "plan"))
BAND, NOISE = role("model-band"), role("noise-band")
FONT = {"family": "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif", "size": 13, "color": role("ink")}
TOOLBAR_PX = 42
"""On the right of a chart: the buttons stand there one below the other, and cover neither legend nor line."""


def axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis with its quantity and unit."""
    words = {"text": title, "standoff": 8, "font": {"size": 12}}
    return {"title": words, "gridcolor": role("grid"), "zerolinecolor": role("zero"), "automargin": True, **more}


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


def figure(data: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """Lines and their layout."""
    return {"data": data, "layout": layout(**more)}


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


def filled(
    x: Sequence[float], lower: Sequence[float], upper: Sequence[float], words: str, fill: str = BAND
) -> list[dict[str, Any]]:
    """Two traces with the band between them filled."""
    return [
        line(x, upper, "", MODEL, 0, showlegend=False, **QUIET),
        line(x, lower, words, MODEL, 0, fill="tonexty", fillcolor=fill, **QUIET),
    ]


def band_of(document: dict[str, Any], curve: str) -> dict[str, Any]:
    """A curve's band in MODEL.json; empty where the method gives none."""
    return ((document.get("uncertainty") or {}).get("bands") or {}).get(curve) or {}


def band(known: dict[str, Any], along: str) -> list[dict[str, Any]]:
    """A curve's band as MODEL.json has it; nothing where it has none."""
    return filled(known[along], known["whole_lower"], known["whole_upper"], "95 % band") if known else []


# ---- under the pointer: quantity, unit, and as many digits as the measurement carries -----------------------------

TORQUE, RESIDUAL, WIDTH, SHARE = "%{y:.2f} N·m", "%{y:+.3f} N·m", "%{y:.0f} µs", "%{y:.3f}"
FACTOR = "%{y:.2f}"
BESIDE = " · %{customdata}"
AT_TIME = {"unifiedhovertitle": {"text": "%{x:.2f} s"}}
AT_WIDTH = {"unifiedhovertitle": {"text": "%{x:.0f} µs"}}
AT_ANGLE = {"unifiedhovertitle": {"text": "%{x:.0f}°"}}
QUIET = {"hoverinfo": "skip"}


def hover(words: str, value: str, customdata: Sequence[Any] | None = None) -> dict[str, Any]:
    """A trace's hover text."""
    template = {"hovertemplate": f"{words} {value}<extra></extra>"}
    return template if customdata is None else {**template, "customdata": list(customdata)}


def hover_band(words: str, value: str, x: Sequence[float], known: dict[str, Any], along: str) -> dict[str, Any]:
    """A curve's hover text with the half width of its band, which has points of its own; `along`: their name."""
    halves = halves_of(known.get("whole_lower", ()), known.get("whole_upper", ()))
    return hover_halves(words, value, [interpolate(at, known[along], halves) for at in x] if known else [])


def halves_of(lower: Sequence[float], upper: Sequence[float]) -> list[float]:
    """Half widths of a band."""
    return [(high - low) / 2 for low, high in zip(lower, upper, strict=True)]


def hover_halves(words: str, value: str, halves: Sequence[float]) -> dict[str, Any]:
    """A curve's hover text with the half width of its band at each of its points; without it if there are none."""
    if not halves:
        return hover(words, value)
    return hover(words, f"{value} ± %{{customdata}}", [f"{half:.2f}" for half in halves])


def interpolate(at: float, x: Sequence[float], y: Sequence[float]) -> float:
    """Linear interpolation; the last value beyond the end."""
    for index in range(1, len(x)):
        if at <= x[index]:
            return y[index - 1] + (at - x[index - 1]) / (x[index] - x[index - 1]) * (y[index] - y[index - 1])
    return y[-1]


def name_segments(
    time_s: Sequence[float], segments: Sequence[dict[str, Any]], words: Callable[[str], str] = segment_name
) -> list[str]:
    """What the segment at each time is called."""
    found, at = [], 0
    names = [words(segment["name"]) for segment in segments] or [""]
    for moment in time_s:
        while at < len(segments) - 1 and moment >= segments[at + 1]["start_s"]:
            at += 1
        found.append(names[at])
    return found

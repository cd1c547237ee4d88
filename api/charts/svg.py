"""The page's figures as still SVG: for print, for a report that needs no script, for a browser with scripts off.

Takes the same objects that plotly draws: lines, markers, filled bands, boxes, dashed lines, labels, stacked y axes.
"""

from __future__ import annotations

import math
from typing import Any

from markupsafe import Markup, escape

from stimrig.api.charts.figure import paint_light, role
from stimrig.api.language import localised

LEFT, RIGHT, TOP, BOTTOM = 62.0, 14.0, 40.0, 42.0
FONT = "system-ui, 'DejaVu Sans', sans-serif"
INK, DIM, GRID_COLOUR, EDGE = (role(name) for name in ("ink", "dim", "grid", "cursor"))
STROKES = {"dash": "6 4", "dot": "2 3", "dashdot": "7 3 2 3"}
LEGEND_GAP = 16.0
WIDE_LETTER = 7.0


def svg(
    figure: dict[str, Any], width: float = 720.0, height: float | None = None, label: str = "", on_paper: bool = False
) -> Markup:
    """A figure as an SVG element.

    Parameters
    ----------
    figure : dict
        ``data`` and ``layout`` as `stimrig.api.charts.model_charts` makes them.
    width, height : float
        px; default height: the layout's.
    label : str
        For who cannot see it.
    on_paper : bool
        With the light colours in it; else the page's style sheet colours it.
    """
    plane = Plane(figure, width, height or figure["layout"].get("height", 340))
    parts = [*plane.frame(), *plane.boxes(), *plane.traces(), *plane.labels(), *plane.legend()]
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="still" viewBox="0 0 {width:g} {plane.height:g}" role="img" '
        f'aria-label="{escape(label)}" font-family="{FONT}" font-size="11.5">'
    )
    drawn = head + "".join(parts) + "</svg>"
    return Markup(paint_light(drawn) if on_paper else drawn)


class Plane:
    """Where a figure's values lie on the paper."""

    def __init__(self, figure: dict[str, Any], width: float, height: float) -> None:
        self.data, self.layout = figure["data"], figure["layout"]
        self.width, self.height = width, height
        self.x_axis = self.layout.get("xaxis") or {}
        self.categories: list[str] = []
        if self.x_axis.get("type") == "category":
            self.categories = list(dict.fromkeys(x for trace in self.data for x in trace["x"]))
        own = [x for trace in self.data for x in self.xs(trace)]
        self.x_range: list[float] = list(self.x_axis.get("range") or bounds(own))
        self.names = sorted({trace.get("yaxis") or "y" for trace in self.data}) or ["y"]
        self.y_ranges = {name: self.y_bounds(name) for name in self.names}

    def xs(self, trace: dict[str, Any]) -> list[float]:
        """A trace's x as numbers."""
        return [self.categories.index(x) for x in trace["x"]] if self.categories else trace["x"]

    def axis(self, name: str) -> dict[str, Any]:
        """A y axis by its short name."""
        return self.layout.get("yaxis" + name[1:]) or {}

    def y_bounds(self, name: str) -> tuple[float, float]:
        """The values' range with some room."""
        values = [y for trace in self.data if (trace.get("yaxis") or "y") == name for y in trace["y"] if y is not None]
        shapes = [s for s in self.layout.get("shapes") or [] if s["type"] == "line" and s.get("yref", "y") == name]
        low, high = bounds(values + [shape["y0"] for shape in shapes])
        if self.axis(name).get("rangemode") == "tozero":
            low, high = min(low, 0.0), max(high, 0.0)
        room = 0.05 * (high - low)
        return (low - room if low < 0 or low > room else low), high + room

    def x(self, value: float) -> float:
        """Value to paper."""
        low, high = self.x_range
        return LEFT + (value - low) / ((high - low) or 1.0) * (self.width - LEFT - RIGHT)

    def span(self, name: str) -> tuple[float, float]:
        """Bottom and top of an axis' part of the paper."""
        low, high = self.axis(name).get("domain") or (0.0, 1.0)
        tall = self.height - TOP - BOTTOM
        return self.height - BOTTOM - low * tall, self.height - BOTTOM - high * tall

    def y(self, value: float, name: str) -> float:
        """Value to paper."""
        low, high = self.y_ranges[name]
        bottom, top = self.span(name)
        return bottom + (value - low) / ((high - low) or 1.0) * (top - bottom)

    # ---- parts ----------------------------------------------------------------------------------------------

    def frame(self) -> list[str]:
        """Grid, ticks and titles."""
        parts = []
        for name in self.names:
            bottom, top = self.span(name)
            for value in ticks(*self.y_ranges[name], max(3, round((bottom - top) / 30))):
                at = self.y(value, name)
                parts.append(stroke(LEFT, at, self.width - RIGHT, at, GRID_COLOUR))
                parts.append(text(LEFT - 7, at + 4, plain(value), DIM, "end"))
            title = (self.axis(name).get("title") or {}).get("text", "")
            lines = title.split(" (") if 6.6 * len(title) > bottom - top else [title]
            middle = (bottom + top) / 2
            for at, words in zip((10, 24), [lines[0], *("(" + rest for rest in lines[1:])], strict=False):
                parts.append(text(at, middle, words, INK, "middle", f' transform="rotate(-90 {at} {middle:.1f})"'))
        floor = self.height - BOTTOM
        parts.append(stroke(LEFT, floor, self.width - RIGHT, floor, EDGE))
        low, high = self.x_range
        marks: list[tuple[float, str]] = [(number, words) for number, words in enumerate(self.categories)]
        marks = marks or [(value, plain(value)) for value in ticks(low, high, max(3, round(self.width / 90)))]
        parts += [text(self.x(value), floor + 15, words, DIM, "middle") for value, words in marks]
        title = (self.x_axis.get("title") or {}).get("text", "")
        return [*parts, text((LEFT + self.width - RIGHT) / 2, self.height - 6, title, INK, "middle")]

    def boxes(self) -> list[str]:
        """Shades and dashed lines."""
        parts = []
        for shape in self.layout.get("shapes") or []:
            whole = shape.get("xref") == "paper"
            x0, x1 = (LEFT, self.width - RIGHT) if whole else (self.x(shape["x0"]), self.x(shape["x1"]))
            name = shape.get("yref", "y")
            y0, y1 = self.height - BOTTOM, TOP
            if name != "paper":
                y0, y1 = self.y(shape["y0"], name), self.y(shape["y1"], name)
            if shape["type"] == "line":
                parts.append(stroke(x0, y0, x1, y1, shape["line"]["color"], ' stroke-dasharray="6 4"'))
            else:
                parts.append(
                    f'<rect x="{x0:.1f}" y="{min(y0, y1):.1f}" width="{max(0.0, x1 - x0):.1f}" '
                    f'height="{abs(y1 - y0):.1f}" fill="{shape["fillcolor"]}"/>'
                )
        return parts

    def traces(self) -> list[str]:
        """Lines, bands and markers."""
        parts, before = [], ""
        for trace in self.data:
            name, line = trace.get("yaxis") or "y", trace.get("line") or {}
            points = [
                None if y is None else (self.x(x), self.y(y, name))
                for x, y in zip(self.xs(trace), trace["y"], strict=True)
            ]
            path = way(points, line.get("shape") == "hv")
            if trace.get("fill") == "tonexty" and before:
                back = way([point for point in reversed(points) if point], False).replace("M", "L", 1)
                parts.append(f'<path d="{before}{back}Z" fill="{trace["fillcolor"]}"/>')
            elif "lines" in trace.get("mode", "lines") and line.get("width", 1):
                parts.append(
                    f'<path d="{path}" fill="none" stroke="{line["color"]}" stroke-width="{line["width"]:g}" '
                    f'stroke-linejoin="round"{dashed(line.get("dash"))}/>'
                )
            if "markers" in trace.get("mode", ""):
                parts += [symbol(point, trace, line["color"]) for point in points if point]
            before = path
        return parts

    def labels(self) -> list[str]:
        """Names of the segments, numbers of the worst places."""
        parts = []
        for note in self.layout.get("annotations") or []:
            at = note["x"] if note.get("xref") != "paper" else None
            x = LEFT + 4 if at is None else self.x(at)
            paper = note.get("yref") == "paper"
            foot = self.height - BOTTOM
            y = foot - note["y"] * (foot - TOP) - 4 if paper else self.y(note["y"], "y") - 5
            words = note["text"].replace("<b>", "").replace("</b>", "")
            number = note.get("name") == "place"
            if at is not None:  # a long name near the end of the test stays on the paper
                x = max(LEFT, min(x, self.width - 0.5 * WIDE_LETTER * len(words)))
            colour = role("worst") if number else (note.get("font") or {}).get("color", DIM)
            parts.append(text(x, y + (16 if number else 0), words, colour, "start" if at is None else "middle"))
        return parts

    def legend(self) -> list[str]:
        """Who is who, in a row on top."""
        shown = [t for t in self.data if t.get("name") and t.get("showlegend", self.layout.get("showlegend", True))]
        if len(shown) < 2:
            return []
        letters = sum(len(trace["name"]) for trace in shown)
        free = self.width - 4.0 - 19 * len(shown)
        small = free < WIDE_LETTER * letters + 0.5 * LEGEND_GAP * len(shown)
        letter, more = (0.87 * WIDE_LETTER, ' font-size="10"') if small else (WIDE_LETTER, "")
        gap = min(LEGEND_GAP, max(0.0, (free - letter * letters) / len(shown)))
        wide = [gap + 19 + letter * len(trace["name"]) for trace in shown]
        parts, x = [], LEFT if LEFT + sum(wide) < self.width else 4.0
        for trace, room in zip(shown, wide, strict=True):
            colour = trace.get("fillcolor") or trace["line"]["color"]
            if trace.get("mode") == "markers":
                parts.append(symbol((x + 8, 10.0), trace, colour))
            else:
                parts.append(f'<rect x="{x:.1f}" y="6" width="14" height="8" rx="2" fill="{colour}"/>')
            parts.append(text(x + 19, 14, trace["name"], INK, "start", more))
            x += room
        return parts


def bounds(values: list[float]) -> tuple[float, float]:
    """Least and largest; 0 to 1 of nothing, and never a range of no width."""
    if not values:
        return 0.0, 1.0
    low, high = min(values), max(values)
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def ticks(low: float, high: float, count: int) -> list[float]:
    """Round values between two, about so many."""
    rough = (high - low) / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def plain(value: float) -> str:
    """A tick's number."""
    return localised(f"{round(value, 9):g}".replace("-", "−"))


def way(points: list[tuple[float, float] | None], steps: bool) -> str:
    """A path through points; a gap at None; stairs if asked for."""
    found: list[str] = []
    before: tuple[float, float] | None = None
    for point in points:
        if point is not None:
            if before is not None and steps:
                found.append(f"L{point[0]:.1f} {before[1]:.1f}")
            found.append(f"{'M' if before is None else 'L'}{point[0]:.1f} {point[1]:.1f}")
        before = point
    return "".join(found)


def stroke(x0: float, y0: float, x1: float, y1: float, colour: str, more: str = "") -> str:
    """A straight line."""
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}"{more}/>'


def dashed(kind: str | None) -> str:
    """A trace's dash."""
    return f' stroke-dasharray="{STROKES[kind]}"' if kind in STROKES else ""


def text(x: float, y: float, words: str, colour: str, anchor: str, more: str = "") -> str:
    """Words."""
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" text-anchor="{anchor}"{more}>{escape(words)}</text>'


def symbol(point: tuple[float, float], trace: dict[str, Any], colour: str) -> str:
    """A marker: a triangle that points up or down, or a dot."""
    (x, y), kind = point, (trace.get("marker") or {}).get("symbol", "circle")
    if kind == "circle":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>'
    sign = -1 if kind == "triangle-up" else 1
    corners = f"{x - 4:.1f},{y - sign * 3:.1f} {x + 4:.1f},{y - sign * 3:.1f} {x:.1f},{y + sign * 4:.1f}"
    return f'<polygon points="{corners}" fill="{role("chart")}" stroke="{colour}" stroke-width="1.5"/>'

"""The page's figures as still SVG: for print, for a report that needs no script, for a browser with scripts off.

Takes the same objects that plotly draws: lines, markers, filled bands, boxes, dashed lines, labels, stacked y axes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from markupsafe import Markup, escape

from stimrig.api.charts.figure import TOOLBAR_PX, paint_light, role
from stimrig.api.charts.strokes import bounds, dashed, marker_px, plain, stairs, stroke, symbol, text, ticks, way

LEFT, RIGHT, BOTTOM = 62.0, 14.0, 38.0
TOP, NAMES_PX, LEGEND_PX = 8.0, 14.0, 18.0
"""Above the lines: room, more for the segments' names, more for the legend."""
FONT = "system-ui, 'DejaVu Sans', sans-serif"
INK, DIM, GRID_COLOUR, EDGE = (role(name) for name in ("ink", "dim", "grid", "cursor"))
LEGEND_GAP, SAMPLE = 12.0, 20.0
WIDE_LETTER = 6.6
WIDE = ("comparison", "residual", "falling", "story-torque", "story-place")
"""Charts that a report gives its whole width."""
NARROW = 560.0
"""A narrower chart has no room for the segments' names."""
SAID = re.compile(r"%\{y:(\+?)\.(\d)f\}(.*?)(?: ·| ±|<)")
X_SAID = re.compile(r"%\{x:(\+?)\.(\d)f\}(.*)")
"""Sign, digits and unit of what is said under the pointer."""


def svg(
    figure: dict[str, Any], width: float = 720.0, height: float | None = None, label: str = "", on_paper: bool = False,
    right: float = RIGHT,
) -> Markup:  # fmt: skip
    """A figure as an SVG element.

    Parameters
    ----------
    figure : dict
        ``data`` and ``layout`` as `stimrig.api.charts.model_charts` makes them.
    width, height : float
        px; default height: the layout's.
    label : str
        For who cannot see it; without one, what stands around it says it.
    on_paper : bool
        With the light colours in it; else the page's style sheet colours it.
    right : float
        px; room on the right.
    """
    plane = Plane(figure, width, height or figure["layout"].get("height", 340), right)
    parts = [*plane.frame(), *plane.boxes(), *plane.traces(), *plane.labels(), *plane.legend()]
    words = f'role="img" aria-label="{escape(label)}"' if label else 'aria-hidden="true"'
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="still" viewBox="0 0 {width:g} {plane.height:g}" {words} '
        f'font-family="{FONT}" font-size="11.5" data-x="{plane.scale_words(plane.x_scale)}"{plane.head_said()}>'
    )
    if on_paper:  # a viewer with a dark ground shows it as well
        parts.insert(0, f'<rect width="100%" height="100%" fill="{role("chart")}"/>')
    drawn = head + "".join(parts) + "</svg>"
    return Markup(paint_light(drawn) if on_paper else drawn)


class Figures(dict[str, dict[str, Any]]):
    """The figures of a page or a file by name, for the macro of `chart.html`.

    `at` is the address of each, with `{}` for its name; without one each still stands in its place, as in a file.
    `captions`: what is to stand below some of them.
    """

    def __init__(
        self, figures: dict[str, dict[str, Any]], at: str = "", captions: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(figures)
        self.at, self.captions = at, captions or {}

    def height(self, name: str) -> float:
        """A figure's height, px."""
        return self[name]["layout"].get("height", 340)

    def address(self, name: str, kind: str) -> str:
        """Where a figure is fetched from: `html` a still for the page, `svg` one to keep, `json` its lines."""
        return self.at.format(f"{name}.{kind}")

    def still(self, name: str, width: float = 760.0) -> Markup:
        """One of them, drawn; in a file on paper, and as wide as its place there."""
        if self.at:
            return svg(self[name], width, right=TOOLBAR_PX)
        return svg(self[name], 1120.0 if name in WIDE else 560.0, on_paper=True)


class Plane:
    """Where a figure's values lie on the paper."""

    def __init__(self, figure: dict[str, Any], width: float, height: float, right: float) -> None:
        self.layout, self.width, self.height, self.end = figure["layout"], width, height, width - right
        self.data = [trace for trace in figure["data"] if self.axis(trace.get("yaxis") or "y").get("visible", True)]
        self.notes = [note for note in self.layout.get("annotations") or [] if width >= NARROW or note.get("name")]
        named = any(note.get("yanchor") == "bottom" and note["y"] == 1.0 for note in self.notes)
        self.top = TOP + NAMES_PX * named + LEGEND_PX * len(self.legend_rows())
        self.x_axis = self.layout.get("xaxis") or {}
        self.categories: list[str] = []
        if self.x_axis.get("type") == "category":
            self.categories = list(dict.fromkeys(x for trace in self.data for x in trace["x"]))
        own = [x for trace in self.data for x in self.xs(trace)]
        low, high = self.x_axis.get("range") or bounds(own)
        self.x_scale = (low, LEFT, (self.end - LEFT) / ((high - low) or 1.0))
        self.x_range = (low, high)
        self.names = sorted({trace.get("yaxis") or "y" for trace in self.data}) or ["y"]
        self.y_ranges = {name: self.y_bounds(name) for name in self.names}
        self.y_scales = {name: self.y_scale(name) for name in self.names}

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

    def span(self, name: str) -> tuple[float, float]:
        """Bottom and top of an axis' part of the paper."""
        low, high = self.axis(name).get("domain") or (0.0, 1.0)
        tall = self.height - self.top - BOTTOM
        return self.height - BOTTOM - low * tall, self.height - BOTTOM - high * tall

    def y_scale(self, name: str) -> tuple[float, float, float]:
        """The lowest value, where it lies, and px for each unit."""
        low, high = self.y_ranges[name]
        bottom, top = self.span(name)
        return low, bottom, (top - bottom) / ((high - low) or 1.0)

    def x(self, value: float) -> float:
        """Value to paper."""
        first, at, each = self.x_scale
        return at + (value - first) * each

    def y(self, value: float, name: str) -> float:
        """Value to paper."""
        first, at, each = self.y_scales[name]
        return at + (value - first) * each

    @staticmethod
    def scale_words(scale: tuple[float, float, float]) -> str:
        """A scale for the script that reads a still."""
        return " ".join(f"{part:.6g}" for part in scale)

    # ---- parts ----------------------------------------------------------------------------------------------

    def frame(self) -> list[str]:
        """Grid, ticks and titles."""
        parts = []
        for name in self.names:
            bottom, top = self.span(name)
            for value in ticks(*self.y_ranges[name], max(3, round((bottom - top) / 30))):
                at = self.y(value, name)
                parts.append(stroke(LEFT, at, self.end, at, GRID_COLOUR))
                parts.append(text(LEFT - 7, at + 4, plain(value), DIM, "end"))
            title = (self.axis(name).get("title") or {}).get("text", "")
            lines = title.split(" (") if 6.6 * len(title) > bottom - top else [title]
            middle = (bottom + top) / 2
            for at, words in zip((12, 25), [lines[0], *("(" + rest for rest in lines[1:])], strict=False):
                parts.append(text(at, middle, words, INK, "middle", f' transform="rotate(-90 {at} {middle:.1f})"'))
        floor = self.height - BOTTOM
        parts.append(stroke(LEFT, floor, self.end, floor, EDGE))
        low, high = self.x_range
        marks: list[tuple[float, str]] = list(enumerate(self.category_words()))
        marks = marks or [(value, plain(value)) for value in ticks(low, high, max(3, round(self.width / 90)))]
        parts += [text(self.x(value), floor + 15, words, DIM, "middle") for value, words in marks]
        title = (self.x_axis.get("title") or {}).get("text", "")
        return [*parts, text((LEFT + self.end) / 2, self.height - 6, title, INK, "middle")]

    def boxes(self) -> list[str]:
        """Shades and dashed lines."""
        parts = []
        for shape in self.layout.get("shapes") or []:
            whole = shape.get("xref") == "paper"
            x0, x1 = (LEFT, self.end) if whole else (self.x(shape["x0"]), self.x(shape["x1"]))
            name = shape.get("yref", "y")
            y0, y1 = self.height - BOTTOM, self.top
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

    def category_words(self) -> list[str]:
        """What stands below a chart of categories: their numbers only, where the names have no room."""
        if WIDE_LETTER * sum(map(len, self.categories)) < self.end - LEFT:
            return self.categories
        return [name.split(" ")[0] for name in self.categories]

    def traces(self) -> list[str]:
        """Lines, bands and markers."""
        parts, before = [], ""
        for trace in self.data:
            name, line = trace.get("yaxis") or "y", trace.get("line") or {}
            (x0, px0, x_each), (y0, py0, y_each) = self.x_scale, self.y_scales[name]
            points = [
                None if y is None else (px0 + (x - x0) * x_each, py0 + (y - y0) * y_each)
                for x, y in zip(self.xs(trace), trace["y"], strict=True)
            ]
            path = way(stairs(points) if line.get("shape") == "hv" else points)
            if trace.get("fill") == "tonexty" and before:
                back = way([point for point in reversed(points) if point]).replace("M", "L", 1)
                parts.append(f'<path d="{before}{back}Z" fill="{trace["fillcolor"]}"/>')
            elif "lines" in trace.get("mode", "lines") and line.get("width", 1):
                parts.append(
                    f'<path d="{path}" fill="none" stroke="{line["color"]}" stroke-width="{line["width"]:g}" '
                    f'stroke-linejoin="round"{dashed(line.get("dash"))}{self.said(trace)}/>'
                )
            if "markers" in trace.get("mode", ""):
                parts += [symbol(point, trace, k) for k, point in enumerate(points) if point and marker_px(trace, k)]
            before = path
        return parts

    def head_said(self) -> str:
        """The same for x, where it is said."""
        how = X_SAID.search((self.x_axis.get("unifiedhovertitle") or {}).get("text", ""))
        return f' data-how="{escape("|".join(how.groups()))}"' if how else ""

    def said(self, trace: dict[str, Any]) -> str:
        """For the script that reads a still: a line's name, scale, and how its values are written."""
        how = SAID.search(trace.get("hovertemplate", ""))
        if how is None:
            return ""
        scale = self.scale_words(self.y_scales[trace.get("yaxis") or "y"])
        return f' data-name="{escape(trace["name"])}" data-y="{scale}" data-how="{escape("|".join(how.groups()))}"'

    def labels(self) -> list[str]:
        """Names of the segments, numbers of the worst places."""
        parts = []
        for note in self.notes:
            at = note["x"] if note.get("xref") != "paper" else None
            x = LEFT + 4 if at is None else self.x(at)
            foot, words = self.height - BOTTOM, note["text"].replace("<b>", "").replace("</b>", "")
            y = foot - note["y"] * (foot - self.top) if note.get("yref") == "paper" else self.y(note["y"], "y") - 1
            y += {"middle": 4, "top": 14}.get(note.get("yanchor", ""), -4)
            if at is not None:  # a long name near the end of the test stays on the paper
                x = max(LEFT, min(x, self.width - 0.5 * WIDE_LETTER * len(words)))
            if ground := note.get("bgcolor"):
                half = 4 + WIDE_LETTER * len(words) / 2
                parts.append(f'<rect x="{x - half:.1f}" y="{y - 12:.1f}" width="{2 * half:.1f}" height="16" '
                             f'fill="{ground}"/>')  # fmt: skip
            colour = (note.get("font") or {}).get("color", DIM)
            parts.append(text(x, y, words, colour, "start" if at is None else "middle"))
        return parts

    def legend_entries(self) -> list[dict[str, Any]]:
        """The traces that a legend names."""
        shown = self.layout.get("showlegend", True)
        return [trace for trace in self.data if trace.get("name") and trace.get("showlegend", shown)]

    def legend_rows(self) -> list[list[tuple[float, dict[str, Any]]]]:
        """The entries of a legend in rows, each with its place; none where one line needs no name."""
        shown = self.legend_entries()
        if len(shown) < 2:
            return []
        rows: list[list[tuple[float, dict[str, Any]]]] = [[]]
        first = x = LEFT if self.width >= NARROW else 4.0
        for trace in shown:
            wide = SAMPLE + 5 + WIDE_LETTER * len(trace["name"])
            if rows[-1] and x + wide > self.width:
                rows.append([])
                x = first
            rows[-1].append((x, trace))
            x += wide + LEGEND_GAP
        return rows

    def legend(self) -> list[str]:
        """Who is who, on top: each with its dash, width and marker."""
        parts = []
        for number, row in enumerate(self.legend_rows()):
            at = 10.0 + LEGEND_PX * number
            for x, trace in row:
                line = trace["line"]
                if colour := trace.get("fillcolor"):
                    parts.append(
                        f'<rect x="{x:.1f}" y="{at - 4:g}" width="{SAMPLE:g}" height="8" rx="2" fill="{colour}"/>'
                    )
                elif "lines" in trace.get("mode", "lines"):
                    look = f' stroke-width="{line["width"]:g}"{dashed(line.get("dash"))}'
                    parts.append(stroke(x, at, x + SAMPLE, at, line["color"], look))
                if "markers" in trace.get("mode", ""):
                    parts.append(symbol((x + SAMPLE / 2, at), trace))
                parts.append(text(x + SAMPLE + 5, at + 4, trace["name"], INK, "start"))
        return parts

"""The strokes that stills are made of: paths of what a screen shows, dashes, markers, words, round ticks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

from markupsafe import escape

STROKES = {"dash": "6 4", "dot": "2 3", "dashdot": "7 3 2 3", "longdash": "11 4", "longdashdot": "11 3 2 3"}
Point = tuple[float, float]


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
    return f"{round(value, 9):g}".replace("-", "−")


def stairs(points: list[Point | None]) -> Iterator[Point | None]:
    """The same with a corner before each change."""
    before: Point | None = None
    for point in points:
        if point is not None and before is not None and point[1] != before[1]:
            yield point[0], before[1]
        yield point
        before = point


def rounded(points: Iterable[Point | None]) -> Iterator[Point | None]:
    """Of each column of pixels the lowest and the highest point, in their order: what a screen shows."""
    column: list[Point] = []
    for point in points:
        if column and (point is None or int(point[0]) != int(column[0][0])):
            yield from extremes(column)
            column = []
        if point is None:
            yield None
        else:
            column.append(point)
    yield from extremes(column)


def extremes(column: list[Point]) -> list[Point]:
    """The lowest and the highest of a few, in their order."""
    if len(column) < 3:
        return column
    heights = [y for _x, y in column]
    return [column[k] for k in sorted((heights.index(min(heights)), heights.index(max(heights))))]


def way(points: Iterable[Point | None]) -> str:
    """A path through points, in steps of a tenth of a pixel from each to the next; a gap at None."""
    found: list[str] = []
    before: tuple[int, int] | None = None
    for point in rounded(points):
        now = None if point is None else (round(10 * point[0]), round(10 * point[1]))
        if now is not None and before is not None:
            found.append(f"l{(now[0] - before[0]) / 10:g} {(now[1] - before[1]) / 10:g}".replace(" -", "-"))
        elif now is not None:
            found.append(f"M{now[0] / 10:g} {now[1] / 10:g}")
        before = now
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


SYMBOLS = {
    "triangle-up": "M{0} {1}m-{2} {2}h{3}l-{2}-{3}Z", "triangle-down": "M{0} {1}m-{2}-{2}h{3}l-{2} {3}Z",
    "diamond": "M{0} {1}m-{2} 0l{2}-{2} {2} {2}-{2} {2}Z",
}  # fmt: skip


def marker_px(trace: dict[str, Any], number: int) -> float:
    """The size of a trace's marker at one of its points; 0: there is none."""
    size = (trace.get("marker") or {}).get("size", 8)
    return size[number] if isinstance(size, list) else size


def symbol(point: Point, trace: dict[str, Any], number: int = 0) -> str:
    """A marker: a triangle that points up or down, a diamond, or a dot."""
    (x, y), marker = point, trace.get("marker") or {}
    half = marker_px(trace, number) / 2
    fill, edge = marker.get("color") or trace["line"]["color"], marker.get("line") or {}
    look = f'fill="{fill}"' + (f' stroke="{edge["color"]}" stroke-width="{edge["width"]:g}"' if edge else "")
    if (shape := SYMBOLS.get(marker.get("symbol", ""))) is None:
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{half:g}" {look}/>'
    return f'<path d="{shape.format(f"{x:.1f}", f"{y:.1f}", f"{half:g}", f"{2 * half:g}")}" {look}/>'

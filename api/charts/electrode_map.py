"""An array as it lies: how good each choice is expected to be, how sure that is, and which one comes next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup, escape

from stimrig.api.charts.figure import role

STEP, RADIUS, EDGE = 66.0, 24.0, 36.0
"""From element to element, of one whose utility is quite sure, and around all, px."""


def array_map(found: dict[str, Any], label: str) -> Markup:
    """The map of a search. Darker is better; a smaller spot is less sure; pairs that were tried are bars."""
    columns, proposed = found["columns"], found["proposal"]["elements"]
    best = max([one["utility"]["mean"] for one in found["map"]], default=0.0) or 1.0

    def at(element: int) -> tuple[float, float]:
        row, column = divmod(element - 1, columns)
        return EDGE + STEP * column, EDGE + STEP * row

    pairs = [one for one in found["map"] if len(one["elements"]) == 2 and one["stimulated"]]
    parts = [_bar(at(one["elements"][0]), at(one["elements"][1]), one, best) for one in pairs]
    if len(proposed) == 2:
        parts.append(_line(at(proposed[0]), at(proposed[1]), role("stimulate"), 3, 'stroke-dasharray="5 4"'))
    single = [(one["elements"][0], one) for one in found["map"] if len(one["elements"]) == 1]
    parts += [_spot(*at(element), one, best, ringed=element in proposed) for element, one in single]
    width, height = (2 * EDGE + STEP * (count - 1) for count in (columns, found["rows"]))
    head = f'<svg class="array" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(label)}" '
    return Markup(f'{head}font-size="15" font-weight="600">{"".join(parts)}</svg>')


def said(one: dict[str, Any]) -> str:
    """What is expected of a choice, in a line."""
    said = {name: f"{one[name]['mean']:.1f} ± {one[name]['sd']:.1f}" for name in ("utility", "torque_nm")}
    words = "utility {utility} N·m, torque {torque_nm} N·m".format(**said)
    return f"{named(one['elements'])}: {words}"


def named(elements: Sequence[int]) -> str:
    """A choice, short."""
    return "+".join(map(str, elements))


def _look(one: dict[str, Any], best: float) -> tuple[float, float]:
    """How dark, and how large."""
    share, doubt = one["utility"]["mean"] / best, one["utility"]["sd"] / best
    return min(1.0, max(0.06, share)), 1.0 - 0.6 * min(1.0, doubt)


def _spot(x: float, y: float, one: dict[str, Any], best: float, ringed: bool) -> str:
    dark, large = _look(one, best)
    ink, edge = role("model"), 2.5 if one["stimulated"] else 1
    ring = f'<circle cx="{x}" cy="{y}" r="{RADIUS + 6}" fill="none" stroke="{role("stimulate")}" stroke-width="4"/>'
    return (
        f'<g><title>{escape(said(one))}</title><circle cx="{x}" cy="{y}" r="{RADIUS}" fill="{role("chart")}" '
        f'stroke="{ink if one["stimulated"] else role("edge")}" stroke-width="{edge}"/>'
        f'<circle cx="{x}" cy="{y}" r="{RADIUS * large:.1f}" fill="{ink}" fill-opacity="{dark:.2f}"/>'
        f'<text x="{x}" y="{y + 5}" text-anchor="middle" fill="{role("ink")}" stroke="{role("chart")}" '
        f'stroke-width="4" paint-order="stroke">{one["elements"][0]}</text>{ring * ringed}</g>'
    )


def _bar(start: tuple[float, float], end: tuple[float, float], one: dict[str, Any], best: float) -> str:
    dark, large = _look(one, best)
    bar = _line(start, end, role("model"), 20 * large, f'stroke-opacity="{dark:.2f}"')
    ground = _line(start, end, role("edge"), 22) + _line(start, end, role("chart"), 20)
    return f"<g><title>{escape(said(one))}</title>{ground}{bar}</g>"


def _line(start: tuple[float, float], end: tuple[float, float], colour: str, width: float, more: str = "") -> str:
    ends = f'x1="{start[0]}" y1="{start[1]}" x2="{end[0]}" y2="{end[1]}"'
    return f'<line {ends} stroke="{colour}" stroke-width="{width:.1f}" {more}/>'

"""Small pictures of what trials said: gain, threshold, time scale and error against the reference over the trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup, escape

from stimrig.api import language
from stimrig.api.charts import trend_charts
from stimrig.api.charts.trend_charts import BOTTOM, LEFT, RIGHT, TALL, TOP, WIDE, Point
from stimrig.api.language import _
from stimrig.api.models.tracking import Bounds

FOOT = 16.0
"""For the name of the axis below its numbers."""
MOST_LABELS = 12


def panels(trials: Sequence[Mapping[str, Any]], bounds: Bounds) -> list[dict[str, Any]]:
    """The pictures: each `title`, `unit`, `latest` (in words), `svg`.

    Parameters
    ----------
    trials : sequence of mapping
        As `stimrig.api.models.tracked.told` gives them, the oldest first.
    bounds : Bounds
        What a person allowed, drawn as lines.
    """
    shown = [
        ("gain", _("Gain"), "%", 100.0),
        ("threshold_shift_us", _("Threshold shift"), "µs", 1.0),
        ("time_scale", _("Time scale"), "%", 100.0),
    ]
    found = [
        _panel(trials, *one, [factor * end for end in bounds.get(one[0], ())]) for one in shown for factor in [one[3]]
    ]
    if any(trial["error_percent"] is not None for trial in trials):
        found.append(_panel(trials, "error_percent", _("Error against the reference"), "%", 1.0, []))
    return found


def _panel(
    trials: Sequence[Mapping[str, Any]], name: str, title: str, unit: str, factor: float, lines: list[float]
) -> dict[str, Any]:
    points = [_point(trial, name, unit, factor) for trial in trials]
    known = [point for point in points if point["value"] is not None]
    drawn = Picture(points, lines, unit).svg(f"{title}, {unit}") if known else Markup("")
    return {"title": title, "unit": unit, "latest": known[-1]["words"] if known else "–", "svg": drawn}


def _point(trial: Mapping[str, Any], name: str, unit: str, factor: float) -> Point:
    level: dict[str, Any] = {"value": trial[name]} if name == "error_percent" else (trial["now"] or {}).get(name) or {}
    value, half = level.get("value"), None
    if name != "error_percent" and value is not None:
        half = factor * (level["high"] - level["low"]) / 2.0
    words = "–" if value is None else said(factor * value, half, unit)
    tip = "\n".join((_("Trial %(number)s", number=trial["number"]), language.clock(trial["at_utc"]), words))
    return {
        "at_s": float(trial["number"]), "value": None if value is None else factor * value, "half": half,
        "current_ma": None, "approved": trial["outcome"] in ("followed", "little"), "noted": bool(trial["ask"]),
        "words": words, "tip": tip,
    }  # fmt: skip


def said(value: float, half: float | None, unit: str) -> str:
    """A value with its band: 92.4 ± 0.8 %."""
    text = f"{value:.1f}" + ("" if half is None else f" ± {half:.1f}")
    return language.localised(text.replace("-", "−")) + "\u00a0" + unit


class Picture(trend_charts.Plane):
    """One quantity over the numbers of the trials, with the limits that a person allowed."""

    tall = TALL + FOOT

    def __init__(self, points: list[Point], lines: list[float], unit: str) -> None:
        super().__init__(points, breaks=False)
        self.lines_at, self.unit = lines, unit

    def frame(self) -> list[str]:
        """Grid and values, the unit above them, and the limits."""
        return [*super().frame(), f'<text class="x" x="1" y="{TOP - 2:g}">{self.unit}</text>', *self.limits()]

    def limits(self) -> list[str]:
        """The limits that lie within the picture."""
        return [
            f'<path class="limit" d="M{LEFT:g} {self.y(value):.1f}H{WIDE - RIGHT:g}"/>'
            for value in self.lines_at
            if self.low <= value <= self.high
        ]

    def dates(self) -> list[str]:
        """The numbers of the trials."""
        every = -(-len(self.points) // MOST_LABELS)
        at = f'y="{TALL - 5:g}" text-anchor="middle"'
        marks = [
            f'<text class="x" x="{self.x(one["at_s"]):.1f}" {at}>{one["at_s"]:.0f}</text>'
            for one in self.points[::every]
        ]
        middle = (LEFT + WIDE - RIGHT) / 2
        name = escape(_("Number of the trial"))
        return [*marks, f'<text class="x" x="{middle:g}" y="{TALL + 11:g}" text-anchor="middle">{name}</text>']

    def columns(self) -> list[str]:
        """What the pointer meets, told by the browser itself: the card is renewed while somebody points at it."""
        half = (WIDE - LEFT - RIGHT) / (2 * max(len(self.points), 1))
        return [
            f'<rect class="column" x="{self.x(one["at_s"]) - half:.1f}" y="0" '
            f'width="{2 * half:.1f}" height="{TALL - BOTTOM:g}"><title>{escape(one["tip"])}</title></rect>'
            for one in self.points
        ]

"""Small pictures, one above another: a participant's figures over the sessions, and what a model's trials said.

They are SVG in the page's own colours: a dozen of them are there at once, and they follow the dark mode by themselves.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup, escape

from stimrig.api import local_time
from stimrig.api.charts.strokes import plain, ticks
from stimrig.api.clock import unix_of, utc_label
from stimrig.api.models import changes
from stimrig.api.models.changes import BEYOND, UNBROKEN, Name
from stimrig.api.models.tracking import Bounds

WIDE, TALL = 400.0, 128.0
LEFT, RIGHT, TOP, BOTTOM = 46.0, 12.0, 12.0, 20.0
LEAST_SPAN = 0.08
"""A picture spans at least this share of its values: what does not change looks as if it did not."""
DAY_S = 86400.0
AXIS_LABELS = 4

Point = dict[str, Any]


def panels(sessions: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The pictures: each `title`, `unit`, `latest` (in words), `svg`.

    `sessions`: as `Session.page_document` gives them, the oldest first.
    """
    return [panel(name, sessions) for name in order(sessions)]


def order(sessions: Sequence[dict[str, Any]]) -> list[str]:
    """The figures that sessions have, in the order in which they are shown."""
    names = dict.fromkeys(name for one in sessions for name in one["figures"])
    first = [name for name in changes.NAMES if name not in changes.LAST]
    effects = [name for name in names if "." in name]
    return [name for name in (*first, *effects, *changes.LAST) if name in names]


def panel(figure: str, sessions: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One figure over the sessions."""
    unit = next((one["figures"][figure]["unit"] for one in sessions if figure in one["figures"]), "1")
    name = changes.name_of(figure, unit)
    points = [point(one, figure, name) for one in sessions]
    known = [one for one in points if one["value"] is not None]
    return {
        "title": name.words,
        "unit": "" if name.unit == "1" else name.unit,
        "latest": known[-1]["words"] if known else "–",
        "svg": Plane(points, figure in ("threshold_us", "plateau_nm")).svg(f"{name.words}, {name.unit}"),
    }


def sessions_told(sessions: Sequence[dict[str, Any]]) -> list[list[Any]]:
    """For the script that says what is under the pointer, for each session: where, when, what else, and its page.

    All pictures have the same sessions in the same places; its value there stands in each picture (`data-words`).
    """
    plane = Plane([{"at_s": unix_of(one["at_utc"]), "value": None} for one in sessions], False) if sessions else None
    return [
        [round(plane.x(unix_of(one["at_utc"])), 1), local_time.when(one["at_utc"]), tip(one),
         f"/models/{one['model_id']}"]
        for one in sessions if plane
    ]  # fmt: skip


def point(session: dict[str, Any], figure: str, name: Name) -> Point:
    """A session's value in the unit that is shown, and what is said of it."""
    found = session["figures"].get(figure) or {"value": None, "uncertainty": None}
    value, uncertainty = found["value"], found["uncertainty"]
    words = changes.uncertain_words(value, uncertainty, name)
    if value is not None and name.unit != "1":
        words = f"{words}{UNBROKEN}{name.unit}"
    return {
        "at_s": unix_of(session["at_utc"]),
        "value": None if value is None else value * name.factor,
        "half": None if uncertainty is None else BEYOND * uncertainty * name.factor,
        "current_ma": session["figures"]["current_ma"]["value"],
        "approved": session["approved"],
        "noted": bool(session["notes"]),
        "words": words,
        "tip": "\n".join(filter(None, (f"{name.words} {words}", found.get("where")))),
    }


def tip(session: dict[str, Any]) -> str:
    """What is said of a session below its value, line by line."""
    by = session["approved_by"]
    lines = [f"approved by {by}" if session["approved"] else "not approved"]
    lines += [f"{note['by']}: {note['text'][:120]}" for note in session["notes"][:4]]
    return "\n".join(lines)


class Plane:
    """Where a figure's values lie in its picture."""

    tall = TALL

    def __init__(self, points: list[Point], breaks: bool) -> None:
        self.points, self.breaks = points, breaks
        self.low, self.high = span(points)
        self.first_s = min(one["at_s"] for one in points)
        self.last_s = max(one["at_s"] for one in points)

    def x(self, at_s: float) -> float:
        """Time to paper; a single session stands in the middle."""
        share = (at_s - self.first_s) / (self.last_s - self.first_s) if self.last_s > self.first_s else 0.5
        return LEFT + 8 + share * (WIDE - LEFT - RIGHT - 16)

    def y(self, value: float) -> float:
        """Value to paper, within the frame."""
        share = (value - self.low) / (self.high - self.low)
        return TALL - BOTTOM - min(max(share, 0.0), 1.0) * (TALL - TOP - BOTTOM)

    def svg(self, label: str) -> Markup:
        """The picture."""
        parts = [*self.frame(), *self.dates(), *self.bands(), *self.lines(), *self.marks(), *self.columns()]
        size = f'viewBox="0 0 {WIDE:g} {self.tall:g}" role="img" aria-label="{escape(label)}"'
        head = f'<svg class="trend" {size} data-words="{escape(json.dumps(self.tips()))}">'
        return Markup(head + "".join(parts) + "</svg>")

    def frame(self) -> list[str]:
        """Grid and values."""
        parts = []
        for value in ticks(self.low, self.high, 4):
            at = self.y(value)
            parts.append(f'<path class="grid" d="M{LEFT:g} {at:.1f}H{WIDE - RIGHT:g}"/>')
            words = escape(plain(value))
            parts.append(f'<text class="y" x="{LEFT - 5:g}" y="{at + 4:.1f}">{words}</text>')
        return parts

    def dates(self) -> list[str]:
        """A few days, or times of day where all was on one."""
        if self.last_s == self.first_s:
            marks = [self.first_s]
        else:
            step_s = (self.last_s - self.first_s) / (AXIS_LABELS - 1)
            marks = [self.first_s + k * step_s for k in range(AXIS_LABELS)]
        short = self.last_s - self.first_s < 2 * DAY_S and len(marks) > 1
        parts = []
        for number, at_s in enumerate(marks):
            label = utc_label(at_s)
            words = local_time.clock(label)[:5] if short else local_time.day(label, year=False)
            anchor = "middle" if 0 < number < len(marks) - 1 or len(marks) == 1 else ("start", "end")[number > 0]
            parts.append(
                f'<text class="x" x="{self.x(at_s):.1f}" y="{TALL - 5:g}" text-anchor="{anchor}">{escape(words)}</text>'
            )
        return parts

    def runs(self) -> list[list[Point]]:
        """Points that a line joins: those with a value; of figures that depend on the current, at the same current."""
        found: list[list[Point]] = []
        before: Point | None = None
        for one in self.points:
            if one["value"] is None:
                before = None
                continue
            apart = before is None or (self.breaks and before["current_ma"] != one["current_ma"])
            if apart:
                found.append([])
            found[-1].append(one)
            before = one
        return found

    def bands(self) -> list[str]:
        """The uncertainty as a band along each line, and as a bar at each point."""
        parts, bars = [], ""
        for run in self.runs():
            known = [one for one in run if one["half"] is not None]
            edge = [(self.x(one["at_s"]), self.y(one["value"] + one["half"])) for one in known]
            edge += [(self.x(one["at_s"]), self.y(one["value"] - one["half"])) for one in reversed(known)]
            if len(known) > 1:
                parts.append(f'<path class="band" d="M{"L".join(f"{x:.1f} {y:.1f}" for x, y in edge)}Z"/>')
            for one in known:
                top, foot = self.y(one["value"] + one["half"]), self.y(one["value"] - one["half"])
                bars += f"M{self.x(one['at_s']):.1f} {top:.1f}V{foot:.1f}"
        return [*parts, f'<path class="bar" d="{bars}"/>'] if bars else parts

    def lines(self) -> list[str]:
        """The lines."""
        ways = [[f"{self.x(one['at_s']):.1f} {self.y(one['value']):.1f}" for one in run] for run in self.runs()]
        return [f'<path class="line" d="M{"L".join(way)}"/>' for way in ways if len(way) > 1]

    def marks(self) -> list[str]:
        """A dot for each session, hollow where nothing is approved; a flag where something is noted."""
        ways = {"flag": "", "dot": "", "hole": ""}
        for one in self.points:
            x = self.x(one["at_s"])
            if one["noted"]:
                ways["flag"] += f"M{x - 4:.1f} 1h8l-4 7Z"
            if one["value"] is not None:  # a line of no length with round ends
                dot = f"M{x:.1f} {self.y(one['value']):.1f}h0"
                ways["dot"] += dot
                ways["hole"] += "" if one["approved"] else dot
        return [f'<path class="{name}" d="{way}"/>' for name, way in ways.items() if way]

    def tips(self) -> list[str]:
        """What is said of each session's value."""
        return [one["tip"] for one in self.points]

    def columns(self) -> list[str]:
        """The mark of the session under the pointer, which a script moves."""
        return [f'<rect class="column" y="0" width="8" height="{TALL - BOTTOM:g}"/>']


def span(points: Sequence[Point]) -> tuple[float, float]:
    """Least and largest that is shown: the values, and their bands as far as they do not dwarf them."""
    values = [one["value"] for one in points if one["value"] is not None]
    if not values:
        return 0.0, 1.0
    low, high = min(values), max(values)
    room = max(high - low, LEAST_SPAN * max(abs(low), abs(high))) or 1.0
    if len(values) == 1:  # no other value that its band could dwarf
        room = max([room, *(one["half"] for one in points if one["half"] is not None)])
    halves = [(one["value"] - one["half"], one["value"] + one["half"]) for one in points if one["half"] is not None]
    foot = max(min((down for down, _up in halves), default=low), low - room)
    top = min(max((up for _down, up in halves), default=high), high + room)
    short = max(room - (max(top, high) - min(foot, low)), 0.0)
    return min(foot, low) - short / 2 - 0.06 * room, max(top, high) + short / 2 + 0.06 * room


# ---- the trials of an approved model --------------------------------------------------------------------------------

FOOT = 16.0
"""For the name of the axis below its numbers."""
MOST_LABELS = 12
TRIAL_FIGURES: dict[str, tuple[Any, str, float]] = {
    "gain": ("Gain", "%", 100.0),
    "threshold_shift_us": ("Threshold shift", "µs", 1.0),
    "time_scale": ("Time scale", "%", 100.0),
    "error_percent": ("Error against the reference", "%", 1.0),
}
"""Name, unit that is shown, and the factor to it."""


def trial_panels(trials: Sequence[Mapping[str, Any]], bounds: Bounds) -> list[dict[str, Any]]:
    """The pictures: each `title`, `unit`, `latest` (in words), `svg`.

    `trials`: as `api.models.tracked.trial_document` gives them, the oldest first; `bounds`: what a person allowed,
    drawn as lines.
    """
    referred = any(trial["error_percent"] is not None for trial in trials)
    return [_trial_panel(trials, name, bounds) for name in TRIAL_FIGURES if referred or name != "error_percent"]


def _trial_panel(trials: Sequence[Mapping[str, Any]], name: str, bounds: Bounds) -> dict[str, Any]:
    title, unit, factor = TRIAL_FIGURES[name]
    points = [_trial_point(trial, name) for trial in trials]
    known = [point for point in points if point["value"] is not None]
    lines = [factor * end for end in bounds.get(name, ())]
    drawn = TrialPlane(points, lines, unit).svg(f"{title}, {unit}") if known else Markup("")
    return {"title": title, "unit": unit, "latest": known[-1]["words"] if known else "–", "svg": drawn}


def _trial_point(trial: Mapping[str, Any], name: str) -> Point:
    value, half = trial_figure(trial, name)
    words = trial_words(trial, name)
    return {
        "at_s": float(trial["number"]), "value": value, "half": half, "current_ma": None,
        "approved": trial["outcome"] in ("followed", "little"), "noted": bool(trial["ask"]), "words": words,
        "tip": "\n".join((f"Trial {trial['number']}", local_time.clock(trial["at_utc"]), words)),
    }  # fmt: skip


def trial_figure(trial: Mapping[str, Any], name: str) -> tuple[float | None, float | None]:
    """A trial's value in the unit that is shown, and half its band; None where it is not known."""
    if name == "error_percent":
        return trial[name], None
    level, factor = (trial["now"] or {}).get(name), TRIAL_FIGURES[name][2]
    return (factor * level["value"], factor * (level["high"] - level["low"]) / 2.0) if level else (None, None)


def trial_words(trial: Mapping[str, Any], name: str) -> str:
    """A trial's value with its band: 92.4 ± 0.8 %."""
    value, half = trial_figure(trial, name)
    if value is None:
        return "–"
    text = f"{value:.1f}" + ("" if half is None else f" ± {half:.1f}")
    return text.replace("-", "−") + UNBROKEN + TRIAL_FIGURES[name][1]


class TrialPlane(Plane):
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
        name = escape("Number of the trial")
        return [*marks, f'<text class="x" x="{middle:g}" y="{TALL + 11:g}" text-anchor="middle">{name}</text>']

    def tips(self) -> list[str]:
        """None: each column says it."""
        return []

    def columns(self) -> list[str]:
        """What the pointer meets, told by the browser itself: the card is renewed while somebody points at it."""
        half = (WIDE - LEFT - RIGHT) / (2 * max(len(self.points), 1))
        return [
            f'<rect class="column" x="{self.x(one["at_s"]) - half:.1f}" y="0" '
            f'width="{2 * half:.1f}" height="{TALL - BOTTOM:g}"><title>{escape(one["tip"])}</title></rect>'
            for one in self.points
        ]

"""Small figures one above another: a participant's figures over the sessions, and what a model's trials said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stimrig.api import local_time
from stimrig.api.charts.drawing import svg
from stimrig.api.charts.figure import Axis, Band, Curve, Figure, Rule
from stimrig.api.clock import unix_of, utc_label
from stimrig.api.models import changes
from stimrig.api.models.changes import BEYOND, OF_THE_CURVE, UNBROKEN
from stimrig.api.models.tracking import Bounds

WIDE_PX, TALL_PX = 400.0, 134.0
LEAST_SPAN = 0.08
"""A panel spans at least this share of its values: what does not change looks as if it did not."""
DAY_S = 86400.0
MOST_DATES, MOST_NUMBERS = 4, 12


@dataclass(frozen=True)
class Point:
    """A session's or a trial's value in the unit that is shown, with half its 95 % band."""

    x: float
    value: float | None
    half: float | None
    approved: bool
    flagged: bool
    text: str
    current_ma: float | None = None


def panels(sessions: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the panels: each `title`, `unit`, `latest` (in words), `values` (under the pointer), `svg`.

    `sessions`: as `Session.page_document` gives them, the oldest first.
    """
    names = dict.fromkeys(name for session in sessions for name in session["figures"])
    first = [name for name in changes.NAMES if name not in changes.LAST]
    effects = [name for name in names if "." in name]
    return [_panel(name, sessions) for name in (*first, *effects, *changes.LAST) if name in names]


def _panel(figure: str, sessions: Sequence[dict[str, Any]]) -> dict[str, Any]:
    unit = next(session["figures"][figure]["unit"] for session in sessions if figure in session["figures"])
    name = changes.name_of(figure, unit)
    points, values = [], []
    for session, (x, *_rest) in zip(sessions, session_rows(sessions), strict=True):
        entry = session["figures"].get(figure) or {"value": None, "uncertainty": None}
        value, uncertainty = entry["value"], entry["uncertainty"]
        text = changes.uncertain_words(value, uncertainty, name)
        text += UNBROKEN + name.unit if value is not None and name.unit != "1" else ""
        values.append("\n".join(filter(None, (f"{name.words} {text}", entry.get("where")))))
        points.append(Point(
            x, None if value is None else value * name.factor,
            None if uncertainty is None else BEYOND * uncertainty * name.factor,
            session["approved"], bool(session["notes"]), text, session["figures"]["current_ma"]["value"],
        ))  # fmt: skip
    panel = _panel_of(points, name.words, name.unit, _dates(sessions), breaks=figure in OF_THE_CURVE)
    return {**panel, "unit": "" if name.unit == "1" else name.unit, "values": values}


def session_rows(sessions: Sequence[dict[str, Any]]) -> list[tuple[float, str, str, str]]:
    """Return of each session its days since the first one, when it was, what is said of it, and its page."""
    start_s = unix_of(sessions[0]["at_utc"]) if sessions else 0.0
    rows = []
    for session in sessions:
        lines = [f"approved by {session['approved_by']}" if session["approved"] else "not approved"]
        lines += [f"{note['by']}: {note['text'][:120]}" for note in session["notes"][:4]]
        days = (unix_of(session["at_utc"]) - start_s) / DAY_S
        rows.append((days, local_time.when(session["at_utc"]), "\n".join(lines), f"/models/{session['model_id']}"))
    return rows


def _dates(sessions: Sequence[dict[str, Any]]) -> Axis:
    """Return the time axis with a few days, or times of day where all was on one."""
    start_s, end_s = (unix_of(sessions[end]["at_utc"]) for end in (0, -1))
    days, count = (end_s - start_s) / DAY_S, MOST_DATES if end_s > start_s else 1
    ticks = []
    for number in range(count):
        share = number / max(count - 1, 1)
        label = utc_label(start_s + share * (end_s - start_s))
        short = count > 1 and days < 2
        ticks.append((share * days, local_time.clock(label)[:5] if short else local_time.day(label, year=False)))
    room = 0.06 * days or 0.5
    return Axis("", limits=(-room, days + room), ticks=ticks)


def _panel_of(points: list[Point], title: str, unit: str, x: Axis, levels: Sequence[float] = (), breaks: bool = False
) -> dict[str, Any]:  # fmt: skip
    known = [point for point in points if point.value is not None]
    figure = history(points, unit, x, levels, breaks)
    drawn = svg(figure, WIDE_PX, label=f"{title}, {unit}") if known else ""
    return {"title": title, "unit": unit, "latest": known[-1].text if known else "–", "svg": drawn}


def history(points: list[Point], unit: str, x: Axis, levels: Sequence[float] = (), breaks: bool = False) -> Figure:
    """Return values with their bands; dots are hollow where nothing is approved, flags say that something is noted.

    A line joins values; with `breaks` only those at the same current.
    """
    low, high = span(points)
    runs = _runs(points, breaks)
    line = [part for run in runs for part in (*((point.x, point.value) for point in run), (run[-1].x, None))]
    banded = [[point for point in run if point.half is not None] for run in runs]
    bands = [_band(run) for run in banded if len(run) > 1]
    bars = [part for run in banded for point in run for part in _bar(point)]
    known = [point for run in runs for point in run]
    curves = [
        Curve([at for at, _ in line], [value for _, value in line], "", "model"),
        Curve([at for at, _ in bars], [value for _, value in bars], "", "model", 0.7),
        *(_dots([point for point in known if point.approved is approved], not approved) for approved in (True, False)),
        Curve([point.x for point in points if point.flagged], [high] * sum(point.flagged for point in points), "",
              "width", 0, marker="down", size=8),
    ]  # fmt: skip
    rules = tuple(Rule(level, colour="width") for level in levels if low <= level <= high)
    return Figure(x, (Axis(unit, limits=(low, high)),), tuple(curves), tuple(bands), rules=rules, height=TALL_PX)


def _runs(points: list[Point], breaks: bool) -> list[list[Point]]:
    runs: list[list[Point]] = []
    before: Point | None = None
    for point in points:
        if point.value is not None:
            if before is None or (breaks and before.current_ma != point.current_ma):
                runs.append([])
            runs[-1].append(point)
        before = point if point.value is not None else None
    return runs


def _edges(point: Point) -> tuple[float, float]:
    value, half = point.value or 0.0, point.half or 0.0
    return value - half, value + half


def _band(run: list[Point]) -> Band:
    lower, upper = zip(*map(_edges, run), strict=True)
    return Band([point.x for point in run], lower, upper, listed=False)


def _bar(point: Point) -> list[tuple[float, float | None]]:
    low, high = _edges(point)
    return [(point.x, low), (point.x, high), (point.x, None)]


def _dots(points: list[Point], hollow: bool) -> Curve:
    return Curve([point.x for point in points], [point.value for point in points], "", "model", 0, marker="circle",
                 size=7, hollow=hollow)  # fmt: skip


def span(points: Sequence[Point]) -> tuple[float, float]:
    """Return the range that is shown: the values, and their bands as far as they do not dwarf them."""
    values = [point.value for point in points if point.value is not None]
    if not values:
        return 0.0, 1.0
    low, high = min(values), max(values)
    room = max(high - low, LEAST_SPAN * max(abs(low), abs(high))) or 1.0
    edges = [_edges(point) for point in points if point.value is not None]
    if len(values) == 1:  # no other value that its band could dwarf
        room = max(room, edges[0][1] - values[0])
    bottom = max(min(below for below, _ in edges), low - room)
    top = min(max(above for _, above in edges), high + room)
    short = max(room - (top - bottom), 0.0)
    return bottom - short / 2 - 0.06 * room, top + short / 2 + 0.1 * room


# ---- the trials of an approved model --------------------------------------------------------------------------------

TRIAL_FIGURES: dict[str, tuple[str, str, float]] = {
    "gain": ("Gain", "%", 100.0),
    "threshold_shift_us": ("Threshold shift", "µs", 1.0),
    "time_scale": ("Time scale", "%", 100.0),
    "error_percent": ("Error against the reference", "%", 1.0),
}
"""Name, unit that is shown, and the factor to it."""


def trial_panels(trials: Sequence[Mapping[str, Any]], bounds: Bounds) -> list[dict[str, Any]]:
    """Return the panels: each `title`, `unit`, `latest` (in words), `svg`.

    `trials`: as `api.models.tracked.trial_document` gives them, the oldest first; `bounds`: what a person allowed,
    drawn as lines.
    """
    referred = any(trial["error_percent"] is not None for trial in trials)
    numbers = [float(trial["number"]) for trial in trials]
    ticks = [(number, f"{number:.0f}") for number in numbers[:: -(-len(numbers) // MOST_NUMBERS)]]
    x = Axis("Number of the trial", limits=(numbers[0] - 0.5, numbers[-1] + 0.5), ticks=ticks)
    drawn = []
    for name, (title, unit, factor) in TRIAL_FIGURES.items():
        if referred or name != "error_percent":
            points = [_trial_point(trial, name) for trial in trials]
            drawn.append(_panel_of(points, title, unit, x, [factor * end for end in bounds.get(name, ())]))
    return drawn


def _trial_point(trial: Mapping[str, Any], name: str) -> Point:
    value, half = trial_figure(trial, name)
    approved = trial["outcome"] in ("followed", "little")
    return Point(float(trial["number"]), value, half, approved, bool(trial["ask"]), trial_words(trial, name))


def trial_figure(trial: Mapping[str, Any], name: str) -> tuple[float | None, float | None]:
    """Return a trial's value in the unit that is shown, and half its band; None where it is not known."""
    if name == "error_percent":
        return trial[name], None
    level, factor = (trial["now"] or {}).get(name), TRIAL_FIGURES[name][2]
    return (factor * level["value"], factor * (level["high"] - level["low"]) / 2.0) if level else (None, None)


def trial_words(trial: Mapping[str, Any], name: str) -> str:
    """Return a trial's value with its band: 92.4 ± 0.8 %."""
    value, half = trial_figure(trial, name)
    if value is None:
        return "–"
    text = f"{value:.1f}" + ("" if half is None else f" ± {half:.1f}")
    return text.replace("-", "−") + UNBROKEN + TRIAL_FIGURES[name][1]

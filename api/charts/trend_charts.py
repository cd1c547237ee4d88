"""Small figures one above another: a participant's figures over the sessions, and what a model's trials said."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

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
    days, x = _days(sessions), _dates(sessions)
    return [_panel(name, sessions, days, x) for name in (*first, *effects, *changes.LAST) if name in names]


def _panel(figure: str, sessions: Sequence[dict[str, Any]], days: Sequence[float], x: Axis) -> dict[str, Any]:
    unit = next(session["figures"][figure]["unit"] for session in sessions if figure in session["figures"])
    name = changes.name_of(figure, unit)
    points, values = [], []
    for session, day in zip(sessions, days, strict=True):
        entry = session["figures"].get(figure) or {"value": None, "uncertainty": None}
        value, uncertainty = entry["value"], entry["uncertainty"]
        text = changes.uncertain_words(value, uncertainty, name)
        text += UNBROKEN + name.unit if value is not None and name.unit != "1" else ""
        values.append("\n".join(filter(None, (text, entry.get("where")))))
        points.append(Point(
            day, None if value is None else value * name.factor,
            None if uncertainty is None else BEYOND * uncertainty * name.factor,
            session["approved"], bool(session["notes"]), text, session["figures"]["current_ma"]["value"],
        ))  # fmt: skip
    panel = _panel_of(points, name.words, name.unit, x, breaks=figure in OF_THE_CURVE)
    return {**panel, "unit": "" if name.unit == "1" else name.unit, "values": "\t".join(values)}


def _days(sessions: Sequence[dict[str, Any]]) -> list[float]:
    """Return the days of each session since the first one."""
    times_s = [unix_of(session["at_utc"]) for session in sessions]
    return [(time_s - times_s[0]) / DAY_S for time_s in times_s]


def session_rows(sessions: Sequence[dict[str, Any]]) -> list[tuple[float, str, str, str]]:
    """Return of each session its days since the first one, when it was, what is said of it, and its page."""
    rows = []
    for session, day in zip(sessions, _days(sessions), strict=True):
        lines = [f"approved by {session['approved_by']}" if session["approved"] else "not approved"]
        lines += [f"{note['by']}: {note['text'][:120]}" for note in session["notes"][:4]]
        rows.append(
            (round(day, 3), local_time.when(session["at_utc"]), "\n".join(lines), f"/models/{session['model_id']}")
        )
    return rows


def _dates(sessions: Sequence[dict[str, Any]]) -> Axis:
    """Return the time axis with a few days, or times of day where all was on one."""
    start_s, days = (unix_of(sessions[0]["at_utc"]), _days(sessions)[-1]) if sessions else (0.0, 0.0)
    count = MOST_DATES if days else 1
    ticks = []
    for number in range(count):
        share = number / max(count - 1, 1)
        label = utc_label(start_s + share * days * DAY_S)
        short = count > 1 and days < 2
        ticks.append((share * days, local_time.clock(label)[:5] if short else local_time.day(label, year=False)))
    room = 0.06 * days or 0.5
    return Axis("", limits=(-room, days + room), ticks=ticks)


def _panel_of(
    points: Sequence[Point], title: str, unit: str, x: Axis, levels: Sequence[float] = (), breaks: bool = False
) -> dict[str, Any]:
    known = [point for point in points if point.value is not None]
    picture = svg(history(points, unit, x, levels, breaks), WIDE_PX, label=f"{title}, {unit}") if known else ""
    return {"title": title, "unit": unit, "latest": known[-1].text if known else "–", "svg": picture}


def history(points: Sequence[Point], unit: str, x: Axis, levels: Sequence[float] = (), breaks: bool = False) -> Figure:
    """Return values with their bands; dots are hollow where nothing is approved, flags say that something is noted.

    A line joins values; with `breaks` only those at the same current.
    """
    rows: list[tuple[float, float, float]] = []
    current_ma: float | None = None
    for point in points:
        if point.value is None or (breaks and point.current_ma != current_ma):
            rows.append((point.x, math.nan, math.nan))
        if point.value is not None:
            rows.append((point.x, point.value, math.nan if point.half is None else point.half))
        current_ma = point.current_ma
    at, value, half = np.array(rows).T
    known = np.nan_to_num(half)
    limits = span(value - known, value + known, value)
    gap = np.isnan(np.pad(value, 1, constant_values=np.nan))
    isolated = np.where(gap[:-2] & gap[2:], half, np.nan)  # a band needs two points
    flags = np.array([point.x for point in points if point.flagged])
    high = np.full(flags.size, limits[1] - 0.04 * (limits[1] - limits[0]))
    open_rows = np.isin(at, [point.x for point in points if not point.approved])
    curves = (
        Curve(at.tolist(), value.tolist(), "", "model"),
        _strokes(at, value - isolated, value + isolated, "model", 0.9),
        _strokes(at, value, value, "model", 7, "round"),
        _strokes(at[open_rows], value[open_rows], value[open_rows], "chart", 3.6, "round"),
        _strokes(flags, high, high, "width", 7, "projecting"),
    )
    band = Band(at.tolist(), (value - half).tolist(), (value + half).tolist())
    rules = tuple(Rule(level, colour="width") for level in levels if limits[0] <= level <= limits[1])
    return Figure(x, (Axis(unit, limits=limits),), curves, (band,), rules=rules, height=TALL_PX)


def _strokes(x: Any, low: Any, high: Any, colour: str, width: float, cap: str = "butt") -> Curve:
    """Return an upright line at each x; one of no length with a cap is a dot, and weighs less than a marker."""
    y = np.column_stack([low, high, np.full(len(x), np.nan)]).ravel()
    return Curve(np.repeat(x, 3).tolist(), y.tolist(), "", colour, width, cap=cap)


def span(lower: Any, upper: Any, value: Any) -> tuple[float, float]:
    """Return the range that is shown: the values, and their bands as far as they do not dwarf them."""
    if np.isnan(value).all():
        return 0.0, 1.0
    low, high = float(np.nanmin(value)), float(np.nanmax(value))
    room = max(high - low, LEAST_SPAN * max(abs(low), abs(high))) or 1.0
    if np.isfinite(value).sum() == 1:  # no other value that its band could dwarf
        room = max(room, float(np.nanmax(upper)) - high)
    bottom, top = max(float(np.nanmin(lower)), low - room), min(float(np.nanmax(upper)), high + room)
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
    pictures = []
    for name, (title, unit, factor) in TRIAL_FIGURES.items():
        if referred or name != "error_percent":
            points = [_trial_point(trial, name) for trial in trials]
            pictures.append(_panel_of(points, title, unit, x, [factor * end for end in bounds.get(name, ())]))
    return pictures


def _trial_point(trial: Mapping[str, Any], name: str) -> Point:
    value, half = _trial_value(trial, name)
    approved = trial["outcome"] in ("followed", "little")
    return Point(float(trial["number"]), value, half, approved, bool(trial["ask"]), trial_words(trial, name))


def _trial_value(trial: Mapping[str, Any], name: str) -> tuple[float | None, float | None]:
    """Return a trial's value in the unit that is shown, and half its band; None where it is not known."""
    if name == "error_percent":
        return trial[name], None
    level, factor = (trial["now"] or {}).get(name), TRIAL_FIGURES[name][2]
    return (factor * level["value"], factor * (level["high"] - level["low"]) / 2.0) if level else (None, None)


def trial_words(trial: Mapping[str, Any], name: str) -> str:
    """Return a trial's value with its band: 92.4 ± 0.8 %."""
    value, half = _trial_value(trial, name)
    if value is None:
        return "–"
    text = f"{value:.1f}" + ("" if half is None else f" ± {half:.1f}")
    return text.replace("-", "−") + UNBROKEN + TRIAL_FIGURES[name][1]

"""Small figures one above another: a participant's figures over the sessions, and what a model's trials said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from stimrig.api import local_time
from stimrig.api.charts.figure import Axis, Figure, Line, Mark, Rule
from stimrig.api.clock import unix_of, utc_label
from stimrig.api.models import changes
from stimrig.api.models.changes import BEYOND, OF_THE_CURVE, UNBROKEN
from stimrig.api.models.tracking import Bounds

WIDE_PX, TALL_PX = 400.0, 134.0
LEAST_SPAN = 0.08
"""A panel spans at least this share of its values: what does not change looks as if it did not."""
DAY_S = 86400.0
MOST_DATES, MOST_NUMBERS = 4, 12
MAX_DOTS = 60
"""More dots than that touch one another, and only make the page heavy: then the line and the bands are shown."""


class Point(NamedTuple):
    """A session's or a trial's value in the unit that is shown, with half its 95 % band."""

    x: float
    value: float | None
    half: float | None
    approved: bool
    flagged: bool
    current_ma: float | None = None
    """A line joins values at the same current."""


def panels(sessions: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the panels: each `title`, `unit`, `latest` (in words), `svg`.

    `sessions`: as `Session.document` gives them, the oldest first.
    """
    if not sessions:
        return []
    times_s = [unix_of(session["at_utc"]) for session in sessions]
    days = [(time_s - times_s[0]) / DAY_S for time_s in times_s]
    x, pictures = _dates(times_s[0], days[-1]), []
    for key in changes.in_order(name for session in sessions for name in session["figures"]):
        figures = [session["figures"].get(key) for session in sessions]
        name = changes.name_of(key, next((each["unit"] for each in figures if each), ""))
        points, words = [], "–"
        for session, day, each in zip(sessions, days, figures, strict=True):
            value, spread = (each["value"], each["uncertainty"]) if each else (None, None)
            if value is not None:
                words = f"{changes.uncertain_words(value, spread, name)}{UNBROKEN}{name.unit}".strip()
            points.append(Point(
                day, None if value is None else value * name.factor,
                None if spread is None else BEYOND * spread * name.factor, session["approved"], bool(session["notes"]),
                session["figures"]["current_ma"]["value"] if key in OF_THE_CURVE else None,
            ))  # fmt: skip
        pictures.append(_panel(points, name.words, name.unit, words, x))
    return pictures


def _dates(start_s: float, days: float) -> Axis:
    """Return the time axis with a few days, or times of day where all was within two."""
    count, ticks = MOST_DATES if days else 1, []
    for number in range(count):
        at = number / max(count - 1, 1) * days
        label = utc_label(start_s + at * DAY_S)
        ticks.append((at, local_time.clock(label)[:5] if 0 < days < 2 else local_time.day(label, year=False)))
    room = 0.06 * days or 0.5
    return Axis("", (-room, days + room), ticks)


def _panel(
    points: Sequence[Point], title: str, unit: str, latest: str, x: Axis, levels: Sequence[float] = ()
) -> dict[str, Any]:
    known = any(point.value is not None for point in points)
    picture = history(points, unit, x, levels).svg(WIDE_PX, label=f"{title}, {unit}") if known else ""
    return {"title": title, "unit": unit, "latest": latest, "svg": picture}


def history(points: Sequence[Point], unit: str, x: Axis, levels: Sequence[float] = ()) -> Figure:
    """Return values with their bands; dots are hollow where nothing is approved, flags say that something is noted."""
    known = [(point, point.value, point.half or 0.0) for point in points if point.value is not None]
    low, high = span([(value - half, value, value + half) for _point, value, half in known])
    line: list[tuple[float, float | None]] = []
    for before, point in zip([points[0], *points[:-1]], points, strict=True):
        if point.current_ma != before.current_ma:
            line.append((point.x, None))
        line.append((point.x, point.value))
    bars = [(point.x, end) for point, value, half in known if half for end in (value - half, value + half, None)]
    marks: list[Mark] = [Line([x for x, _ in line], [y for _, y in line])]
    if bars:
        marks.append(Line([x for x, _ in bars], [y for _, y in bars], "", "model-band", 7.0))
    if len(known) <= MAX_DOTS:
        top = high - 0.04 * (high - low)
        for rows, colour, marker, size in (
            ([(point.x, value) for point, value, _half in known], "model", "o", 7),
            ([(point.x, value) for point, value, _half in known if not point.approved], "chart", "o", 3.6),
            ([(point.x, top) for point in points if point.flagged], "width", "D", 6),
        ):
            if rows:
                marks.append(Line([x for x, _ in rows], [y for _, y in rows], "", colour, 0, marker=marker, size=size))
    marks += [Rule(at, colour="width") for at in levels if low <= at <= high]
    return Figure(x, [Axis(unit, (low, high))], marks, TALL_PX)


def span(ranges: Sequence[tuple[float, float, float]]) -> tuple[float, float]:
    """Return the range that is shown of lower end, value and upper end: bands as far as they do not dwarf values."""
    lower, values, upper = zip(*ranges, strict=True)
    low, high = min(values), max(values)
    room = max(high - low, LEAST_SPAN * max(abs(low), abs(high))) or 1.0
    if len(values) == 1:  # no other value that its band could dwarf
        room = max(room, upper[0] - high)
    bottom, top = max(min(lower), low - room), min(max(upper), high + room)
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
    numbers = [trial["number"] for trial in trials]
    ticks = [(number, str(number)) for number in numbers[:: -(-len(numbers) // MOST_NUMBERS)]]
    x = Axis("Number of the trial", (numbers[0] - 0.5, numbers[-1] + 0.5), ticks)
    pictures = []
    for name, (title, unit, factor) in TRIAL_FIGURES.items():
        points = [
            Point(trial["number"], *_value(trial, name), trial["outcome"] in ("followed", "little"), bool(trial["ask"]))
            for trial in trials
        ]
        known = [trial for trial, point in zip(trials, points, strict=True) if point.value is not None]
        if known or name != "error_percent":
            latest, levels = trial_words(known[-1], name) if known else "–", bounds.get(name, ())
            pictures.append(_panel(points, title, unit, latest, x, [factor * end for end in levels]))
    return pictures


def _value(trial: Mapping[str, Any], name: str) -> tuple[float | None, float | None]:
    """Return a trial's value in the unit that is shown, and half its band; None where it is not known."""
    if name == "error_percent":
        return trial[name], None
    level, factor = (trial["now"] or {}).get(name), TRIAL_FIGURES[name][2]
    return (factor * level["value"], factor * (level["high"] - level["low"]) / 2.0) if level else (None, None)


def trial_words(trial: Mapping[str, Any], name: str) -> str:
    """Return a trial's value with its band: 92.4 ± 0.8 %."""
    value, half = _value(trial, name)
    if value is None:
        return "–"
    words = f"{value:.1f}" + ("" if half is None else f" ± {half:.1f}")
    return words.replace("-", "−") + UNBROKEN + TRIAL_FIGURES[name][1]

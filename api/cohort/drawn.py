"""Figures over a cohort as plain objects for plotly: units on every axis, and words where there is too little."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

from stimrig.api.charts.figure import axis, layout, role, unlinked
from stimrig.api.cohort.gathered import Gathered, wilson

LEAST_CASES = 5
"""Of fewer an interval says next to nothing; it is drawn, and said so."""
MOST_LINES = 20
"""Participants whose lines are drawn: those with the most sessions."""
MOST_PANELS = 12
COLOURS = tuple(role(f"series-{number}") for number in range(1, 7))
DASHES = ("solid", "dash", "dot", "dashdot")
UNITS = {"us": "µs", "nm": "N·m", "s": "s"}
ROW_PX = 26

Figure = dict[str, Any]


def prevalence(found: Gathered) -> Figure | None:
    """Effects by how many have them, with 95 % intervals; None where no effect was found."""
    of_what, total, counts = found.prevalence()
    counts = counts[::-1]  # plotly draws from below
    if not counts:
        return None
    shares = [100 * count / total for _, count in counts]
    ends = [[100 * end for end in wilson(count, total)] for _, count in counts]
    trace = {
        "type": "scatter",
        "mode": "markers",
        "x": shares,
        "y": [_plain(effect) for effect, _ in counts],
        "marker": {"color": role("model"), "size": 9},
        "error_x": {
            "type": "data",
            "symmetric": False,
            "array": [high - share for share, (_, high) in zip(shares, ends, strict=True)],
            "arrayminus": [share - low for share, (low, _) in zip(shares, ends, strict=True)],
            "color": role("model"),
        },
        "text": [f"{count} of {total} {of_what}" for _, count in counts],
        "hovertemplate": "%{y}: %{x:.1f} %<br>%{text}<extra></extra>",
    }
    return _figure(
        [trace],
        ROW_PX * len(counts) + 110,
        xaxis=axis(f"share of {total} {of_what} (%), 95 % interval (Wilson)", range=[0, 100]),
        yaxis=axis("effect"),
    )


def errors(found: Gathered) -> Figure | None:
    """Records without a result, by reason; None where all have one."""
    counts = found.errors.most_common()[::-1]
    if not counts:
        return None
    trace = {
        "type": "bar",
        "orientation": "h",
        "x": [count for _, count in counts],
        "y": [unlinked(kind) for kind, _ in counts],
        "marker": {"color": role("worst")},
        "hovertemplate": "%{y}: %{x} records<extra></extra>",
    }
    title = f"records without a result (number, of {found.records})"
    return _figure([trace], ROW_PX * len(counts) + 110, xaxis=axis(title, rangemode="tozero"), yaxis=axis("reason"))


def shown_parameters(found: Gathered) -> list[tuple[str, str]]:
    """Parameters by how many records have them, those of the model first."""
    ranked = sorted(found.series, key=lambda key: (key[0] != "model", -len(found.series[key].value), key))
    return ranked[:MOST_PANELS]


def over_sessions(found: Gathered, key: tuple[str, str]) -> Figure | None:
    """A parameter over time, a line for each participant; None where nobody has two sessions."""
    series = found.series[key]
    people = {who: points for who, points in series.by_participant().items() if len(points) > 1}
    if not people:
        return None
    drawn = sorted(people, key=lambda who: (-len(people[who]), who))[:MOST_LINES]
    traces = []
    for number, who in enumerate(drawn):
        points, colour = people[who], COLOURS[number % len(COLOURS)]
        sds = [0.0 if math.isnan(sd) else sd for _, _, sd in points]
        traces.append({
            "type": "scatter",
            "mode": "lines+markers",
            "name": unlinked(found.people[who]),
            "x": [datetime.fromtimestamp(at_s, UTC).isoformat() for at_s, _, _ in points],
            "y": [value for _, value, _ in points],
            "error_y": {"type": "data", "array": sds, "color": colour, "thickness": 1},
            "line": {"color": colour, "width": 1.4, "dash": DASHES[number // len(COLOURS) % len(DASHES)]},
            "marker": {"color": colour, "size": 5},
        })  # fmt: skip
    title = f"{title_of(key)} ({series.unit})"
    return _figure(traces, 340, xaxis=axis("day of the session (date, UTC)", type="date"), yaxis=axis(title))


def repeats(found: Gathered) -> list[dict[str, Any]]:
    """Rows of the table of repeatability: one for each parameter that somebody has of two sessions."""
    rows = []
    for key in shown_parameters(found):
        series = found.series[key]
        one = series.repeats()
        if one is not None:
            few = one.participants < LEAST_CASES
            rows.append({"parameter": title_of(key), "unit": series.unit, "few": few, **vars(one)})
    return rows


def title_of(key: tuple[str, str]) -> str:
    """A parameter in words."""
    of, name = key
    for end in UNITS:
        name = name.removesuffix(f"_{end}")
    return _plain(name) if of == "model" else f"{_plain(of)}: {_plain(name)}"


def _plain(name: str) -> str:
    return unlinked(name.replace("_", " "))


def _figure(data: list[dict[str, Any]], height: int, **axes: Any) -> Figure:
    return {"data": data, "layout": layout(height=height, hovermode="closest", showlegend=len(data) > 1, **axes)}

"""The figures over a cohort, units on every axis, and their page: one HTML file that works anywhere, offline."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

from markupsafe import Markup, escape

from stimrig.api.charts.figure import LIGHT
from stimrig.api.charts.model_charts import COLOURS
from stimrig.api.charts.plot import LocalFigure
from stimrig.api.cohort.statistics import PROBABLE, Statistics, wilson

LEAST_CASES = 5
"""Of fewer an interval says next to nothing; it is drawn, and said so."""
MOST_LINES = 20
"""Participants whose lines are drawn: those with the most sessions."""
MOST_PANELS = 12
DASHES = ("solid", "dash", "dot", "dashdot")
UNITS = {"us": "µs", "nm": "N·m", "s": "s"}
ROW_PX = 26

Figure = dict[str, Any]


def prevalence(found: Statistics) -> Figure | None:
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
        "marker": {"color": LIGHT["model"], "size": 9},
        "error_x": {
            "type": "data",
            "symmetric": False,
            "array": [high - share for share, (_, high) in zip(shares, ends, strict=True)],
            "arrayminus": [share - low for share, (low, _) in zip(shares, ends, strict=True)],
            "color": LIGHT["model"],
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


def errors(found: Statistics) -> Figure | None:
    """Records without a result, by reason; None where all have one."""
    counts = found.errors.most_common()[::-1]
    if not counts:
        return None
    trace = {
        "type": "bar",
        "orientation": "h",
        "x": [count for _, count in counts],
        "y": [unlinked(kind) for kind, _ in counts],
        "marker": {"color": LIGHT["worst"]},
        "hovertemplate": "%{y}: %{x} records<extra></extra>",
    }
    title = f"records without a result (number, of {found.records})"
    return _figure([trace], ROW_PX * len(counts) + 110, xaxis=axis(title, rangemode="tozero"), yaxis=axis("reason"))


def ranked_parameters(found: Statistics) -> list[tuple[str, str]]:
    """Parameters by how many records have them, those of the model first."""
    ranked = sorted(found.series, key=lambda key: (key[0] != "model", -len(found.series[key].value), key))
    return ranked[:MOST_PANELS]


def over_sessions(found: Statistics, key: tuple[str, str]) -> Figure | None:
    """A parameter over time, a line for each participant; None where nobody has two sessions."""
    series = found.series[key]
    people = {who: points for who, points in series.by_participant().items() if len(points) > 1}
    if not people:
        return None
    drawn = sorted(people, key=lambda who: (-len(people[who]), who))[:MOST_LINES]
    traces = []
    for number, who in enumerate(drawn):
        points, colour = people[who], LIGHT[COLOURS[number % len(COLOURS)]]
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


def repeats(found: Statistics) -> list[dict[str, Any]]:
    """Rows of the table of repeatability: one for each parameter that somebody has of two sessions."""
    rows = []
    for key in ranked_parameters(found):
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


def unlinked(words: str) -> str:
    """Return words in which plotly sees no link."""
    return words.replace("<", "‹").replace(">", "›")


def axis(title: str, **more: Any) -> dict[str, Any]:
    """Return an axis with its quantity and unit."""
    return {"title": {"text": title, "standoff": 8}, "automargin": True, **more}


def _figure(data: list[dict[str, Any]], height: int, **axes: Any) -> Figure:
    return {"data": data, "layout": {"height": height, "hovermode": "closest", "showlegend": len(data) > 1, **axes}}


STYLE = """
body { font: 15px/1.5 system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif; color: #1b2733;
       max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2rem }
table { border-collapse: collapse } td, th { padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top }
th { border-bottom: 1px solid #d9dfe4 } td.number, th.number { text-align: right }
.few { color: #b3121d }
"""
NOTHING = "Too few: a line needs a participant with two sessions whose participant and day are known."


def page(found: Statistics, name: str) -> str:
    """The page. `found`: from the table of results; `name`: the file's, for the title."""
    pictures = _Pictures()
    parts = [
        *_head(found, name),
        "<h2>Effects by prevalence</h2>",
        *_prevalence(found, pictures),
        "<h2>Parameters over sessions</h2>",
        *_over_sessions(found, pictures),
        "<h2>Repeatability between sessions</h2>",
        *_repeats(found),
        "<h2>Records without a result</h2>",
        "<p>None.</p>" if (figure := errors(found)) is None else pictures(figure),
    ]
    title = escape(f"Cohort: {name}")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style></head><body>\n<h1>{title}</h1>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


class _Pictures:
    """Figures as parts of one page; the library is in it once."""

    def __init__(self) -> None:
        self.loaded = False

    def __call__(self, figure: Figure) -> str:
        part = LocalFigure(figure).to_html(full_html=False, include_plotlyjs=not self.loaded)
        self.loaded = True
        return part


def _head(found: Statistics, name: str) -> list[str]:
    options = found.options
    effects = ", ".join(options.get("effects") or [])
    with_effects = f" (effects: {effects})" if effects else ""
    rows = [
        ("results", name),
        ("verb", f"{options.get('verb')}{with_effects}"),
        ("selected", options.get("select") or "all records"),
        ("software", f"stimrig {options.get('software')}"),
        ("records", f"{found.records}, {found.ok} with a result, {found.errors.total()} without"),
        ("participants", str(len(found.people)) if found.people else "not known"),
        ("verdicts", ", ".join(f"{word.replace('_', ' ')} {count}" for word, count in found.verdicts.most_common())),
    ]
    return [_table((), [(escape(word), escape(str(text))) for word, text in rows])]


def _prevalence(found: Statistics, pictures: _Pictures) -> list[str]:
    of_what, total, counts = found.prevalence()
    figure = prevalence(found)
    if figure is None:
        return [f"<p>No effect was found in {total} {of_what}.</p>"]
    how = "participants whose records show it more often than not" if of_what == "participants" else "records"
    words = [f"<p>Counted are {how}; from a diagnosis, effects with a probability of {PROBABLE:g} or more.</p>"]
    if total < LEAST_CASES:
        words.append(f'<p class="few">Only {total} {of_what}: the intervals are as wide as they look.</p>')
    rows = []
    for effect, count in counts:
        low, high = wilson(count, total)
        share = f"{100 * count / total:.1f} % ({100 * low:.1f} to {100 * high:.1f})"
        rows.append((escape(effect.replace("_", " ")), str(count), str(total), share))
    head = ("effect", of_what, "of", "share, 95 % interval")
    return [*words, pictures(figure), _table(head, rows)]


def _over_sessions(found: Statistics, pictures: _Pictures) -> list[str]:
    figures = [(key, over_sessions(found, key)) for key in ranked_parameters(found)]
    parts = []
    for key, figure in figures:
        if figure is not None:
            words = f"{title_of(key)}, with its standard deviation"
            people = len(figure["data"])
            if people == MOST_LINES:
                words += f"; the {people} participants with the most sessions"
            parts += [f"<p>{escape(words)}</p>", pictures(figure)]
    if not found.series and found.ok and found.options.get("verb") == "diagnose":
        parts.append("<p>A diagnosis gives parameters of missing effects only; `cohort fit` gives the model's.</p>")
    return parts or [f'<p class="few">{NOTHING}</p>']


def _repeats(found: Statistics) -> list[str]:
    rows = repeats(found)
    if not rows:
        return [f'<p class="few">{NOTHING}</p>']
    head = ("parameter", "unit", "participants", "sessions", "mean", "SD within a participant", "SD between",
            "CV within (%)", "ICC(1)", "")  # fmt: skip
    table = [
        (
            escape(row["parameter"]),
            escape(row["unit"]),
            str(row["participants"]),
            str(row["sessions"]),
            *(_number(row[name]) for name in ("mean", "within_sd", "between_sd", "cv_percent", "icc")),
            Markup('<span class="few">few participants</span>') if row["few"] else "",
        )
        for row in rows
    ]
    words = (
        "<p>Participants with two sessions or more; SD within: between sessions of one participant, pooled. It holds "
        "what the muscle did as well as the method's error.</p>"
    )
    return [words, _table(head, table)]


def _number(value: float | None) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.3g}"


def _table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    top = "<tr>" + "".join(f"<th>{escape(word)}</th>" for word in head) + "</tr>" if head else ""
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table>{top}{body}</table>"

"""The figures over a cohort as one HTML file that works anywhere, offline."""

from __future__ import annotations

import math
from typing import Any

from markupsafe import Markup, escape

from stimrig.api.charts.figure import in_light
from stimrig.api.charts.plot import LocalFigure
from stimrig.api.cohort import drawn
from stimrig.api.cohort.gathered import PROBABLE, Gathered, wilson

STYLE = """
body { font: 15px/1.5 system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif; color: #1b2733;
       max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2rem }
table { border-collapse: collapse } td, th { padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top }
th { border-bottom: 1px solid #d9dfe4 } td.number, th.number { text-align: right }
.few { color: #b3121d }
"""
NOTHING = "Too few: a line needs a participant with two sessions whose participant and day are known."


def html(found: Gathered, name: str) -> str:
    """The page.

    Parameters
    ----------
    found : Gathered
        From the table of results.
    name : str
        The file's, for the title.
    """
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
        "<p>None.</p>" if (figure := drawn.errors(found)) is None else pictures(figure),
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

    def __call__(self, figure: drawn.Figure) -> str:
        part = LocalFigure(in_light(figure)).to_html(full_html=False, include_plotlyjs=not self.loaded)
        self.loaded = True
        return part


def _head(found: Gathered, name: str) -> list[str]:
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


def _prevalence(found: Gathered, pictures: _Pictures) -> list[str]:
    of_what, total, counts = found.prevalence()
    figure = drawn.prevalence(found)
    if figure is None:
        return [f"<p>No effect was found in {total} {of_what}.</p>"]
    how = "participants whose records show it more often than not" if of_what == "participants" else "records"
    words = [f"<p>Counted are {how}; from a diagnosis, effects with a probability of {PROBABLE:g} or more.</p>"]
    if total < drawn.LEAST_CASES:
        words.append(f'<p class="few">Only {total} {of_what}: the intervals are as wide as they look.</p>')
    rows = []
    for effect, count in counts:
        low, high = wilson(count, total)
        share = f"{100 * count / total:.1f} % ({100 * low:.1f} to {100 * high:.1f})"
        rows.append((escape(effect.replace("_", " ")), str(count), str(total), share))
    head = ("effect", of_what, "of", "share, 95 % interval")
    return [*words, pictures(figure), _table(head, rows)]


def _over_sessions(found: Gathered, pictures: _Pictures) -> list[str]:
    figures = [(key, drawn.over_sessions(found, key)) for key in drawn.shown_parameters(found)]
    parts = []
    for key, figure in figures:
        if figure is not None:
            words = f"{drawn.title_of(key)}, with its standard deviation"
            people = len(figure["data"])
            if people == drawn.MOST_LINES:
                words += f"; the {people} participants with the most sessions"
            parts += [f"<p>{escape(words)}</p>", pictures(figure)]
    if not found.series and found.ok and found.options.get("verb") == "diagnose":
        parts.append("<p>A diagnosis gives parameters of missing effects only; `cohort fit` gives the model's.</p>")
    return parts or [f'<p class="few">{NOTHING}</p>']


def _repeats(found: Gathered) -> list[str]:
    rows = drawn.repeats(found)
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

"""The page of a cohort: effects by prevalence, parameters over sessions, repeatability, errors.

One HTML file that works offline.
"""

from __future__ import annotations

import base64
import io
import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import cycle
from pathlib import Path
from typing import Any

import jinja2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binomtest

from stimrig.api.charts.drawing import SETTINGS
from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.record import MODEL
from stimrig.api.cohort.table import read_options, read_rows

PROBABLE = 0.5
"""An effect that a diagnosis found missing counts from this probability on."""
FEW_CASES = 5
"""Of fewer an interval says next to nothing; it is drawn, and said so."""
MAX_LINES = 20
"""Participants whose lines are drawn: those with the most sessions."""
MAX_PARAMETERS = 12
STYLES = ("-", "--", ":", "-.")
UNITS = ("_us", "_nm", "_s")
COLUMNS = ("status", "error_kind", "participant", "day", "begun_utc", "verdict", "effects", "parameters")


@dataclass
class Parameter:
    """A parameter's values over all records, by participant: time, value and standard deviation of each session."""

    unit: str
    sessions: dict[str, list[tuple[datetime, float, float]]] = field(default_factory=lambda: defaultdict(list))


@dataclass
class Cohort:
    """Counts and parameters of one table of results."""

    options: dict[str, Any]
    errors: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    effects: Counter[str] = field(default_factory=Counter)  # records with each effect
    participants: Counter[str] = field(default_factory=Counter)  # records with a result of each participant
    effects_of: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    """Records with each effect of each participant, by effect."""
    parameters: dict[tuple[str, str], Parameter] = field(default_factory=dict)
    """By what they belong to (`model`, or an effect with its form), and name."""

    @property
    def ok(self) -> int:
        """Records with a result."""
        return self.verdicts.total()

    def prevalence(self) -> tuple[str, int, list[tuple[str, int]]]:
        """Return what is counted, of how many, and each effect's count, the most frequent first.

        Participants where every record names one: records of the same person are no independent cases. A participant
        counts whose records show the effect more often than not.
        """
        if self.participants.total() < self.ok or not self.participants:
            return "records", self.ok, self.effects.most_common()
        counts = {
            effect: sum(2 * count > self.participants[code] for code, count in counts.items())
            for effect, counts in self.effects_of.items()
        }
        return "participants", len(self.participants), Counter(counts).most_common()

    def ranked_parameters(self) -> list[tuple[str, str]]:
        """List the parameters that most records have, those of the model first."""
        count = {key: sum(map(len, entry.sessions.values())) for key, entry in self.parameters.items()}
        return sorted(count, key=lambda key: (key[0] != MODEL, -count[key], key))[:MAX_PARAMETERS]

    def repeatability(self) -> list[dict[str, Any]]:
        """Return the rows of the table of repeatability: parameters of which somebody has two sessions."""
        rows = []
        for key in self.ranked_parameters():
            parameter = self.parameters[key]
            values = [[value for _, value, _ in sessions] for sessions in parameter.sessions.values()]
            if figures := repeatability(values):
                few = figures["participants"] < FEW_CASES
                rows.append({"parameter": title_of(key), "unit": parameter.unit, "few": few, **figures})
        return rows


def read_cohort(file: Path) -> Cohort:
    """Read a table of results. Raises CohortError: it is none, or empty."""
    cohort = Cohort(read_options(file))
    for row in read_rows(file, COLUMNS):
        if row["status"] == "ok":
            _add(cohort, row)
        else:
            cohort.errors[row["error_kind"] or "unknown"] += 1
    if not cohort.ok + cohort.errors.total():
        raise CohortError(f"{file}: no record in it. Nothing was selected.")
    return cohort


def _add(cohort: Cohort, row: Mapping[str, Any]) -> None:
    participant, day, time_utc = row["participant"], row["day"], row["begun_utc"]
    cohort.verdicts[row["verdict"] or "none"] += 1
    # Of a model all effects count. In two forms of an effect the same name is not the same quantity.
    forms = {
        entry["effect"]: f"{entry['effect']} ({entry['form']})" if entry["form"] else entry["effect"]
        for entry in row["effects"] or []
        if entry["probability"] is None or entry["probability"] >= PROBABLE
    }
    cohort.effects.update(forms.keys())
    if not participant:
        return
    cohort.participants[participant] += 1
    for effect in forms:
        cohort.effects_of[effect][participant] += 1
    if time_utc is None and day is not None:
        time_utc = datetime.combine(day, datetime.min.time(), UTC)
    if time_utc is None:
        return
    for entry in row["parameters"] or []:
        of = MODEL if entry["of"] == MODEL else forms.get(entry["of"])
        if of is not None and entry["value"] is not None:
            parameter = cohort.parameters.setdefault((of, entry["name"]), Parameter(entry["unit"]))
            parameter.sessions[participant].append((time_utc, entry["value"], entry["sd"] or 0.0))


def wilson(count: int, of: int) -> tuple[float, float]:
    """Return the 95 % interval of a share, by Wilson's score."""
    interval = binomtest(count, of).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def repeatability(values: Sequence[Sequence[float]]) -> dict[str, Any] | None:
    """Return how values repeat within a participant, by one-way analysis of variance; None if nobody has two sessions.

    `values`: by participant. `within_sd` is pooled; `between_sd` is the part that sessions do not explain; `icc` is
    ICC(1) of Shrout and Fleiss for single sessions of unequal numbers.
    """
    groups = [np.asarray(group) for group in values if len(group) > 1]
    if not groups:
        return None
    pooled, sizes = np.concatenate(groups), np.array([group.size for group in groups])
    mean, count, total = float(pooled.mean()), len(groups), pooled.size
    within = sum(float(((group - group.mean()) ** 2).sum()) for group in groups) / (total - count)
    between_sd = icc = None
    if count > 1:
        between = float((sizes * np.array([group.mean() - mean for group in groups]) ** 2).sum()) / (count - 1)
        usual = float(total - (sizes**2).sum() / total) / (count - 1)  # sessions of a participant
        between_sd = math.sqrt(max(0.0, (between - within) / usual))
        both = between + (usual - 1) * within
        icc = (between - within) / both if both > 0 else None
    one_sign = pooled.min() > 0 or pooled.max() < 0
    return {
        "participants": count,
        "sessions": total,
        "mean": mean,
        "within_sd": math.sqrt(within),
        "between_sd": between_sd,
        "cv_percent": 100 * math.sqrt(within) / abs(mean) if one_sign else None,
        "icc": icc,
    }


def title_of(key: tuple[str, str]) -> str:
    """Return a parameter in words."""
    of, name = key
    for unit in UNITS:
        name = name.removesuffix(unit)
    return (name if of == MODEL else f"{of}: {name}").replace("_", " ")


def draw_prevalence(cohort: Cohort) -> Figure | None:
    """Draw effects by how many have them, with 95 % intervals; None if no effect was found."""
    of_what, total, counts = cohort.prevalence()
    if not counts:
        return None
    figure = Figure((8, 1.2 + 0.3 * len(counts)), layout="constrained")
    axes = figure.add_subplot()
    shares = np.array([count / total for _, count in counts])
    ends = np.array([wilson(count, total) for _, count in counts]).T
    names = [effect.replace("_", " ") for effect, _ in counts]
    axes.errorbar(100 * shares, names, xerr=100 * np.abs(ends - shares), fmt="o", capsize=3)
    axes.set(xlim=(0, 100), xlabel=f"share of {total} {of_what} (%), 95 % interval (Wilson)", ylabel="effect")
    axes.invert_yaxis()
    return figure


def draw_sessions(cohort: Cohort, key: tuple[str, str]) -> Figure | None:
    """Draw a parameter over time, a line for each participant; None if nobody has two sessions."""
    parameter = cohort.parameters[key]
    several = [code for code, sessions in parameter.sessions.items() if len(sessions) > 1]
    if not several:
        return None
    figure = Figure((8, 3.6), layout="constrained")
    axes = figure.add_subplot()
    styles = cycle((f"C{number % 10}", STYLES[number // 10]) for number in range(40))
    longest = sorted(several, key=lambda code: (-len(parameter.sessions[code]), code))[:MAX_LINES]
    for code, (colour, style) in zip(longest, styles, strict=False):
        times, values, sds = zip(*sorted(parameter.sessions[code]), strict=True)
        axes.errorbar(times, values, yerr=sds, label=code, color=colour, linestyle=style, marker=".", elinewidth=1)
    axes.set(xlabel="day of the session (date, UTC)", ylabel=f"{title_of(key)} ({parameter.unit})")
    figure.autofmt_xdate()
    figure.legend(loc="outside right upper", fontsize="small")
    return figure


def page(cohort: Cohort, name: str) -> str:
    """Return the page of a cohort; `name`: of the file of results, for the title."""
    of_what, total, counts = cohort.prevalence()
    with mpl.rc_context(SETTINGS):  # pyright: ignore[reportArgumentType]
        prevalence = _svg(draw_prevalence(cohort))
        images = ((title_of(key), _svg(draw_sessions(cohort, key))) for key in cohort.ranked_parameters())
        sessions = [(title, image) for title, image in images if image]
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["words"] = lambda text: text.replace("_", " ")
    environment.filters["number"] = lambda value: "–" if value is None or not math.isfinite(value) else f"{value:.3g}"
    template = environment.from_string(Path(__file__).with_name("figures.html").read_text("utf-8"))
    shares = [
        (effect, count, [100 * share for share in (count / total, *wilson(count, total))]) for effect, count in counts
    ]
    return template.render(
        name=name, cohort=cohort, of_what=of_what, total=total, shares=shares, prevalence=prevalence,
        sessions=sessions, repeatability=cohort.repeatability(), few_cases=FEW_CASES, max_lines=MAX_LINES,
        probable=PROBABLE,
    )  # fmt: skip


def _svg(figure: Figure | None) -> str:
    """Return a figure as the address of an image; empty if there is none."""
    if figure is None:
        return ""
    image = io.BytesIO()
    figure.savefig(image, format="svg")
    return f"data:image/svg+xml;base64,{base64.b64encode(image.getvalue()).decode()}"

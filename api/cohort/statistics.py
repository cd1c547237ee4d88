"""What the figures over a cohort are drawn from, taken from a table of results row by row; shares and repeatability."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from statistics import fmean
from typing import Any

from stimrig.api.cohort.record import MODEL
from stimrig.api.cohort.table import options_of, rows_of
from stimrig.api.cohort.tasks import CohortError

PROBABLE = 0.5
"""An effect that a diagnosis found missing counts from this probability on."""
COLUMNS = ("status", "error_kind", "participant", "day", "begun_utc", "verdict", "effects", "parameters")
Z95 = 1.959963984540054


def wilson(count: int, of: int) -> tuple[float, float]:
    """The 95 % interval of a share, by Wilson's score; 0 to 1 of nothing."""
    if of <= 0:
        return 0.0, 1.0
    share, z2 = count / of, Z95**2
    middle = (share + z2 / (2 * of)) / (1 + z2 / of)
    half = Z95 / (1 + z2 / of) * math.sqrt(share * (1 - share) / of + z2 / (4 * of**2))
    return max(0.0, middle - half), min(1.0, middle + half)


@dataclass(frozen=True)
class Repeatability:
    """How a parameter repeats between sessions of the same participant."""

    participants: int  # with at least two sessions
    sessions: int  # theirs
    mean: float  # over all sessions
    within_sd: float  # standard deviation between sessions of one participant, pooled
    between_sd: float | None
    """Standard deviation between participants, the part that sessions don't explain; None with one participant."""
    cv_percent: float | None  # `within_sd` of the mean, %; None where values of both signs make it mean nothing
    icc: float | None
    """Intraclass correlation ICC(1), one way, for single sessions of unequal numbers; None with one participant."""


def repeatability(groups: Sequence[Sequence[float]]) -> Repeatability | None:
    """By one-way analysis of variance over participants with two sessions or more; None where there is none.

    `groups`: values by participant.
    """
    several = [list(group) for group in groups if len(group) > 1]
    if not several:
        return None
    count, sizes = len(several), [len(group) for group in several]
    total = sum(sizes)
    means = [fmean(group) for group in several]
    mean = fmean([value for group in several for value in group])
    within = sum((value - own) ** 2 for group, own in zip(several, means, strict=True) for value in group)
    within /= total - count
    positive = min(min(group) for group in several) > 0 or max(max(group) for group in several) < 0
    cv = 100 * math.sqrt(within) / abs(mean) if positive else None
    if count < 2:
        return Repeatability(count, total, mean, math.sqrt(within), None, cv, None)
    between = sum(size * (own - mean) ** 2 for size, own in zip(sizes, means, strict=True)) / (count - 1)
    usual = (total - sum(size**2 for size in sizes) / total) / (count - 1)
    of_people = max(0.0, (between - within) / usual)
    both = between + (usual - 1) * within
    icc = (between - within) / both if both > 0 else None
    return Repeatability(count, total, mean, math.sqrt(within), math.sqrt(of_people), cv, icc)


@dataclass
class Series:
    """A parameter's values over all records: participant (a number), time, value and standard deviation of each."""

    unit: str
    who: array[int] = field(default_factory=lambda: array("l"))
    at_s: array[float] = field(default_factory=lambda: array("d"))
    value: array[float] = field(default_factory=lambda: array("d"))
    sd: array[float] = field(default_factory=lambda: array("d"))

    def by_participant(self) -> dict[int, list[tuple[float, float, float]]]:
        """Time, value and sd of each session, in the order of time, by participant."""
        found: dict[int, list[tuple[float, float, float]]] = {}
        for who, *point in zip(self.who, self.at_s, self.value, self.sd, strict=True):
            found.setdefault(who, []).append(tuple(point))  # pyright: ignore[reportArgumentType]
        return {who: sorted(points) for who, points in found.items()}

    def repeats(self) -> Repeatability | None:
        """How it repeats between the sessions of a participant; None where nobody has two."""
        return repeatability([[value for _, value, _ in points] for points in self.by_participant().values()])


@dataclass
class Statistics:
    """Counts and series of one table of results."""

    options: dict[str, Any]
    records: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    effects: Counter[str] = field(default_factory=Counter)
    """Records with each effect."""
    people: list[str] = field(default_factory=list)
    people_records: Counter[str] = field(default_factory=Counter)
    """Records with a result of each participant."""
    people_effects: dict[str, Counter[str]] = field(default_factory=dict)
    """The same by effect."""
    series: dict[tuple[str, str], Series] = field(default_factory=dict)
    """By what the parameter belongs to (`model`, or an effect with its form), and its name."""

    @property
    def ok(self) -> int:
        return self.records - self.errors.total()

    def prevalence(self) -> tuple[str, int, list[tuple[str, int]]]:
        """What is counted, of how many, and each effect's count, the most frequent first.

        Participants, where every record names one: records of the same person are no independent cases. A participant
        counts whose records show the effect more often than not.
        """
        if self.people_records.total() < self.ok or not self.people:
            return "records", self.ok, self.effects.most_common()
        counts = Counter({
            effect: sum(2 * count > self.people_records[code] for code, count in by.items())
            for effect, by in self.people_effects.items()
        })  # fmt: skip
        return "participants", len(self.people_records), counts.most_common()


def read_statistics(file: Path) -> Statistics:
    """Read a table of results. Raises CohortError: it is none, or empty."""
    found = Statistics(options_of(file))
    numbers: dict[str, int] = {}
    for row in rows_of(file, COLUMNS):
        found.records += 1
        if row["status"] != "ok":
            found.errors[row["error_kind"] or "unknown"] += 1
            continue
        _take(found, row, numbers)
    found.people = list(numbers)
    if not found.records:
        raise CohortError(f"{file}: no record in it. Nothing was selected.")
    return found


def _take(found: Statistics, row: Mapping[str, Any], numbers: dict[str, int]) -> None:
    who = row["participant"]
    found.verdicts[row["verdict"] or "none"] += 1
    if who:
        found.people_records[who] += 1
        numbers.setdefault(who, len(numbers))
    forms = _effects(row)
    for effect in forms:
        found.effects[effect] += 1
        if who:
            found.people_effects.setdefault(effect, Counter())[who] += 1
    at_s = _at_s(row)
    if not who or at_s is None:
        return
    for entry in row["parameters"] or []:
        of = entry["of"] if entry["of"] == MODEL else forms.get(entry["of"])
        if of is not None and entry["value"] is not None:
            series = found.series.setdefault((of, entry["name"]), Series(entry["unit"]))
            series.who.append(numbers[who])
            series.at_s.append(at_s)
            series.value.append(entry["value"])
            series.sd.append(float("nan") if entry["sd"] is None else entry["sd"])


def _effects(row: Mapping[str, Any]) -> dict[str, str]:
    """Effects that count: of a model all, of a diagnosis those that are probable.

    Each with its form: what bears the same name in two forms of an effect is not the same quantity.
    """
    return {
        entry["effect"]: f"{entry['effect']} ({entry['form']})" if entry["form"] else entry["effect"]
        for entry in row["effects"] or []
        if entry["probability"] is None or entry["probability"] >= PROBABLE
    }


def _at_s(row: Mapping[str, Any]) -> float | None:
    """When the record was made, as Unix time."""
    if row["begun_utc"] is not None:
        return row["begun_utc"].timestamp()
    return None if row["day"] is None else datetime.combine(row["day"], datetime.min.time(), UTC).timestamp()

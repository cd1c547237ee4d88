"""What the figures over a cohort are drawn from, taken from a table of results row by row."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from api.cohort.answers import MODEL
from api.cohort.errors import CohortError
from api.cohort.read import options_of, rows_of
from api.cohort.statistics import Repeatability, repeatability

PROBABLE = 0.5
"""An effect that a diagnosis found missing counts from this probability on."""
COLUMNS = ("status", "error_kind", "participant", "day", "begun_utc", "verdict", "effects", "parameters")


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
class Gathered:
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
        """Records with a result."""
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


def gather(file: Path) -> Gathered:
    """Read a table of results.

    Raises
    ------
    CohortError
        It is none, or empty.
    """
    options = options_of(file)
    if options is None:
        raise CohortError(f"{file}: no such file. Give the -o of `stimrig cohort fit`, `diagnose` or `improve`.")
    found = Gathered(options)
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


def _take(found: Gathered, row: Mapping[str, Any], numbers: dict[str, int]) -> None:
    """One record with a result."""
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

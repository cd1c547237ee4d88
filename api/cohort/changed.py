"""Two runs over the same records compared: whose result differs, and how; what a new release is judged by."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stimrig.api.cohort.table import options_of, rows_in, rows_of
from stimrig.api.cohort.tasks import OPTIONS, CohortError, differing

PROBABILITY = 0.05
"""A probability that moves by no more has not changed."""
SDS = 1.0
"""A parameter has moved if it moved by more than so many of its standard deviations, the larger of both runs'."""
RELATIVE = 0.01
"""Where it has none: by more than this share of its value."""
RMS_RELATIVE = 0.02
"""An error on held-out pulses that moves by no more than this share has not changed."""
ROWS_AT_ONCE = 100_000
"""Rows of OLD held in memory; of more, both files are read several times."""
COLUMNS = (
    "sha256", "address", "record_id", "name", "participant", "day", "status", "error_kind", "error", "verdict",
    "probability", "held_out_rms_nm", "effects", "parameters",
)  # fmt: skip
KINDS = (
    "error to ok", "ok to error", "other error", "verdict", "effect gained", "effect lost", "probability", "parameter",
    "held-out error",
)  # fmt: skip
"""Kinds of change, the weightiest first."""
Row = Mapping[str, Any]


@dataclass
class Changes:
    """What differs between two runs."""

    old: dict[str, Any]
    new: dict[str, Any]
    options: str = ""
    """How their options differ, apart from the version of stimrig: then not only that may be the cause."""
    same: int = 0  # records in both whose results do not differ by more than the tolerances
    rows: list[dict[str, Any]] = field(default_factory=list)
    """Records that differ: `record`, `participant`, `day`, `kinds`, `why`."""
    only_old: list[str] = field(default_factory=list)  # records in the old run only
    only_new: list[str] = field(default_factory=list)

    def take(self, old: Row | None, new: Row | None) -> None:
        """Judge one record's rows, of which one may be missing."""
        if old is None or new is None:
            for row, names in ((old, self.only_old), (new, self.only_new)):
                if row is not None:
                    names.append(_in_words(row))
        elif why := list(differences(old, new)):
            day = None if new["day"] is None else new["day"].isoformat()
            kinds = sorted({kind for kind, _ in why}, key=KINDS.index)
            about = {"record": _in_words(new), "participant": new["participant"], "day": day}
            self.rows.append({**about, "kinds": kinds, "why": [words for _, words in why]})
        else:
            self.same += 1

    def counts(self) -> dict[str, int]:
        """Records by kind of change; one may count in several."""
        found = Counter(kind for row in self.rows for kind in row["kinds"])
        return {kind: found[kind] for kind in KINDS if found[kind]}

    def to_dict(self) -> dict[str, Any]:
        """As `--json` gives it."""
        return {
            "old": self.old,
            "new": self.new,
            "other_options": self.options,
            "compared": self.same + len(self.rows),
            "unchanged": self.same,
            "changed": len(self.rows),
            "counts": self.counts(),
            "tolerances": {
                "probability": PROBABILITY,
                "parameter_sd": SDS,
                "parameter_without_sd_relative": RELATIVE,
                "held_out_rms_relative": RMS_RELATIVE,
            },
            "records": self.rows,
            "only_in_old": self.only_old,
            "only_in_new": self.only_new,
        }


def compared(old: Path, new: Path) -> Changes:
    """Compare two tables of results, record by record (by SHA-256; by address where a record could not be read).

    Raises CohortError: a file is no table of results, or they are of two verbs.
    """
    before, after = _options(old), _options(new)
    if before["verb"] != after["verb"]:
        raise CohortError(f"{new}: results of {after['verb']}, {old} of {before['verb']}. Give two of one verb.")
    options = differing({**before, "software": after["software"]}, after)
    changes = Changes({"file": str(old), **before}, {"file": str(new), **after}, options)
    unread_old, unread_new = (
        {row["address"]: row for row in rows_of(file, COLUMNS) if not row["sha256"]} for file in (old, new)
    )
    shares = 1 + rows_in(old) // ROWS_AT_ONCE
    for share in range(shares):
        before = {row["sha256"]: row for row in _share(old, share, shares)}
        for row in _share(new, share, shares):
            changes.take(before.pop(row["sha256"], None) or unread_old.pop(row["address"], None), row)
        for row in before.values():
            changes.take(row, unread_new.pop(row["address"], None))
    for address, row in unread_old.items():
        changes.take(row, unread_new.pop(address, None))
    for row in unread_new.values():
        changes.take(None, row)
    changes.only_old.sort()
    changes.only_new.sort()
    changes.rows.sort(key=lambda row: (KINDS.index(row["kinds"][0]), row["record"]))
    return changes


def _share(file: Path, share: int, shares: int) -> Iterator[Row]:
    """The rows of one share of all contents: not every row is in memory at once."""
    for row in rows_of(file, COLUMNS):
        if row["sha256"] and int(row["sha256"][:8], 16) % shares == share:
            yield row


def _options(file: Path) -> dict[str, Any]:
    options = options_of(file)
    return {name: options.get(name) for name in OPTIONS}


def _in_words(row: Row) -> str:
    return str(row["record_id"] or row["name"] or row["address"])


def differences(old: Row, new: Row) -> Iterator[tuple[str, str]]:
    """How one record's results differ: kind, and words."""
    if "error" in (old["status"], new["status"]):
        yield from _errors(old, new)
        return
    if old["verdict"] != new["verdict"]:
        yield "verdict", f"verdict {_words(old['verdict'])} → {_words(new['verdict'])}"
    elif _apart(old["probability"], new["probability"], PROBABILITY):
        yield "probability", f"of the verdict {_number(old['probability'])} → {_number(new['probability'])}"
    yield from _effects(old, new)
    yield from _parameters(old, new)
    before, after = old["held_out_rms_nm"], new["held_out_rms_nm"]
    if _apart(before, after, RMS_RELATIVE * max(abs(before or 0.0), abs(after or 0.0))):
        yield "held-out error", f"held-out error {_number(before)} → {_number(after)} N·m"


def _errors(old: Row, new: Row) -> Iterator[tuple[str, str]]:
    if new["status"] == "ok":
        yield "error to ok", f"was {old['error_kind']}: {old['error']}; now {_words(new['verdict'])}"
    elif old["status"] == "ok":
        yield "ok to error", f"was {_words(old['verdict'])}; now {new['error_kind']}: {new['error']}"
    elif old["error_kind"] != new["error_kind"]:
        yield "other error", f"was {old['error_kind']}; now {new['error_kind']}: {new['error']}"


def _effects(old: Row, new: Row) -> Iterator[tuple[str, str]]:
    before, after = ({entry["effect"]: entry for entry in row["effects"] or []} for row in (old, new))
    for effect in sorted(after.keys() - before.keys()):
        yield "effect gained", f"{effect} gained{_chance(after[effect])}"
    for effect in sorted(before.keys() - after.keys()):
        yield "effect lost", f"{effect} lost{_chance(before[effect])}"
    for effect in sorted(before.keys() & after.keys()):
        was, now = before[effect]["probability"], after[effect]["probability"]
        if _apart(was, now, PROBABILITY):
            yield "probability", f"{effect} {_number(was)} → {_number(now)}"


def _parameters(old: Row, new: Row) -> Iterator[tuple[str, str]]:
    """Those that moved, of what both have: that an effect came or went is said already."""
    before, after = ({(p["of"], p["name"]): p for p in row["parameters"] or []} for row in (old, new))
    for of, name in sorted(before.keys() & after.keys()):
        was, now = before[of, name], after[of, name]
        sds = [p["sd"] for p in (was, now) if p["sd"]]
        largest = max(abs(was["value"] or 0.0), abs(now["value"] or 0.0))
        allowed = SDS * max(sds) if sds else RELATIVE * largest
        if _apart(was["value"], now["value"], max(allowed, 1e-9 * largest)):
            unit = "" if now["unit"] == "1" else f" {now['unit']}"
            sd = f" (sd {_number(max(sds))})" if sds else ""
            yield "parameter", f"{of} {name} {_number(was['value'])} → {_number(now['value'])}{unit}{sd}"


def _apart(before: float | None, after: float | None, allowed: float) -> bool:
    if before is None or after is None:
        return before is not after
    return abs(after - before) > allowed


def _chance(entry: Row) -> str:
    return "" if entry["probability"] is None else f" (probability {_number(entry['probability'])})"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.4g}"


def _words(verdict: str | None) -> str:
    return str(verdict or "none").replace("_", " ")

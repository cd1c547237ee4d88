"""Compare two runs over the same records: whose result differs, and how; a new release is judged by it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.table import read_options, read_rows
from stimrig.api.cohort.task import OPTIONS, describe_differences

TOLERANCES = {
    "probability": 0.05,
    "parameter_sd": 1.0,  # standard deviations, the larger of both runs'
    "parameter_without_sd_relative": 0.01,
    "held_out_rms_relative": 0.02,
}
"""Differences that are no change."""
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


def compare_runs(old: Path, new: Path) -> dict[str, Any]:
    """Compare two tables of results; return the keys of `--json`.

    Raises CohortError: a file is no table of results, or they are of two verbs.
    """
    before, after = ({name: read_options(file).get(name) for name in OPTIONS} for file in (old, new))
    if before["verb"] != after["verb"]:
        raise CohortError(f"{new}: results of {after['verb']}, {old} of {before['verb']}. Give two of one verb.")
    unchanged, changed, only = 0, list[dict[str, Any]](), {"old": list[str](), "new": list[str]()}
    for row, other in _pairs(old, new):
        if row is None or other is None:
            only["new" if row is None else "old"].append(_name(row or other or {}))
        elif differences := list(_differences(row, other)):
            day = other["day"] and other["day"].isoformat()
            kinds = sorted({kind for kind, _ in differences}, key=KINDS.index)
            about = {"record": _name(other), "participant": other["participant"], "day": day}
            changed.append({**about, "kinds": kinds, "why": [words for _, words in differences]})
        else:
            unchanged += 1
    changed.sort(key=lambda row: (KINDS.index(row["kinds"][0]), row["record"]))
    counts = Counter(kind for row in changed for kind in row["kinds"])
    return {
        "old": {"file": str(old), **before},
        "new": {"file": str(new), **after},
        # Then the version of stimrig may not be the only cause.
        "other_options": describe_differences({**before, "software": after["software"]}, after),
        "compared": unchanged + len(changed),
        "unchanged": unchanged,
        "changed": len(changed),
        "counts": {kind: counts[kind] for kind in KINDS if counts[kind]},
        "tolerances": TOLERANCES,
        "records": changed,
        "only_in_old": sorted(only["old"]),
        "only_in_new": sorted(only["new"]),
    }


def _pairs(old: Path, new: Path) -> Iterator[tuple[Row | None, Row | None]]:
    """Pair the rows of both runs by SHA-256; by address where a record could not be read in one of them."""
    unread_old, unread_new = (
        {row["address"]: row for row in read_rows(file, COLUMNS) if not row["sha256"]} for file in (old, new)
    )
    shares = 1 + pq.read_metadata(old).num_rows // ROWS_AT_ONCE
    for share in range(shares):
        rows: dict[str, list[Row]] = {}
        for row in _read_share(old, share, shares):
            rows.setdefault(row["sha256"], []).append(row)
        for other in _read_share(new, share, shares):
            same = rows.get(other["sha256"])
            yield same.pop(0) if same else unread_old.pop(other["address"], None), other
        for row in chain.from_iterable(rows.values()):
            yield row, unread_new.pop(row["address"], None)
    for address, row in unread_old.items():
        yield row, unread_new.pop(address, None)
    for row in unread_new.values():
        yield None, row


def _read_share(file: Path, share: int, shares: int) -> Iterator[Row]:
    for row in read_rows(file, COLUMNS):
        if row["sha256"] and int(row["sha256"][:8], 16) % shares == share:
            yield row


def _name(row: Row) -> str:
    return str(row["record_id"] or row["name"] or row["address"])


def _differences(old: Row, new: Row) -> Iterator[tuple[str, str]]:
    """Yield how one record's results differ: kind, and words."""
    if new["status"] == "error":
        now = f"now {new['error_kind']}: {new['error']}"
        if old["status"] == "ok":
            yield "ok to error", f"was {_words(old['verdict'])}; {now}"
        elif old["error_kind"] != new["error_kind"]:
            yield "other error", f"was {old['error_kind']}; {now}"
        return
    if old["status"] == "error":
        yield "error to ok", f"was {old['error_kind']}: {old['error']}; now {_words(new['verdict'])}"
        return
    if old["verdict"] != new["verdict"]:
        yield "verdict", f"verdict {_words(old['verdict'])} → {_words(new['verdict'])}"
    elif _apart(old["probability"], new["probability"], TOLERANCES["probability"]):
        yield "probability", f"of the verdict {_arrow(old['probability'], new['probability'])}"
    yield from _effect_differences(old, new)
    yield from _parameter_differences(old, new)
    before, after = old["held_out_rms_nm"], new["held_out_rms_nm"]
    if _apart(before, after, TOLERANCES["held_out_rms_relative"] * max(abs(before or 0.0), abs(after or 0.0))):
        yield "held-out error", f"held-out error {_arrow(before, after)} N·m"


def _effect_differences(old: Row, new: Row) -> Iterator[tuple[str, str]]:
    before, after = ({entry["effect"]: entry["probability"] for entry in row["effects"] or []} for row in (old, new))
    for effect in sorted(after.keys() - before.keys()):
        yield "effect gained", f"{effect} gained{_in_brackets('probability', after[effect])}"
    for effect in sorted(before.keys() - after.keys()):
        yield "effect lost", f"{effect} lost{_in_brackets('probability', before[effect])}"
    for effect in sorted(before.keys() & after.keys()):
        if _apart(before[effect], after[effect], TOLERANCES["probability"]):
            yield "probability", f"{effect} {_arrow(before[effect], after[effect])}"


def _parameter_differences(old: Row, new: Row) -> Iterator[tuple[str, str]]:
    """Yield parameters that moved, of those that both have: an effect that came or went is said already."""
    before, after = ({(p["of"], p["name"]): p for p in row["parameters"] or []} for row in (old, new))
    for of, name in sorted(before.keys() & after.keys()):
        was, now = before[of, name], after[of, name]
        sd = max(was["sd"] or 0.0, now["sd"] or 0.0)
        largest = max(abs(was["value"] or 0.0), abs(now["value"] or 0.0))
        allowed = TOLERANCES["parameter_sd"] * sd or TOLERANCES["parameter_without_sd_relative"] * largest
        if _apart(was["value"], now["value"], max(allowed, 1e-9 * largest)):
            unit = "" if now["unit"] == "1" else f" {now['unit']}"
            yield "parameter", f"{of} {name} {_arrow(was['value'], now['value'])}{unit}{_in_brackets('sd', sd or None)}"


def _apart(before: float | None, after: float | None, allowed: float) -> bool:
    if before is None or after is None:
        return before is not after
    return abs(after - before) > allowed


def _arrow(before: float | None, after: float | None) -> str:
    return " → ".join("none" if value is None else f"{value:.4g}" for value in (before, after))


def _in_brackets(what: str, value: float | None) -> str:
    return "" if value is None else f" ({what} {value:.4g})"


def _words(verdict: str | None) -> str:
    return str(verdict or "none").replace("_", " ")

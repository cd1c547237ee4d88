"""The fields of a record by which it is chosen, and what is known of them before its file has been read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from typing import Any, Literal

Type = Literal["text", "number", "day"]


@dataclass(frozen=True)
class Field:
    """One field: its type, and what it says, for messages and docs."""

    type: Type
    says: str


FIELDS: dict[str, Field] = {
    "participant": Field("text", "code of the participant"),
    "day": Field("day", "day of the session (UTC), as 2026-01-31"),
    "kind": Field("text", "kind of test"),
    "rig": Field("text", "id of the rig, where a centre knows it"),
    "name": Field("text", "name of the file, or id at a centre"),
    "origin": Field("text", "the DATA it was found in"),
    "record_id": Field("text", "id of the recording"),
    "test_id": Field("text", "id of the test"),
    "outcome": Field("text", "completed, stopped or fault"),
    "duration_s": Field("number", "from the first sample to the last, s"),
    "rate_hz": Field("number", "samples a second"),
    "bytes": Field("number", "size of the file"),
}
"""Every field that `--select` may name. A field is absent from a mapping as long as it is unknown, and None where the
record says nothing of it."""

Known = Mapping[str, Any]


def as_day(value: str) -> str | None:
    """A day as `YYYY-MM-DD`, of a day or a time in ISO 8601; None where it is none."""
    try:
        return date.fromisoformat(value[:10]).isoformat()
    except ValueError:
        return None

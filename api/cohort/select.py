"""The fields of a record, and `--select`: a condition of SQL over them, which SQLite evaluates.

participant in ("P001", "P002") and kind = "pre-session" and day >= "2026-01-01" and not duration_s < 20
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from functools import cache
from typing import Any, Literal

from stimrig.api.cohort.errors import CohortError
from stimrig.rig.messages import Labels


@dataclass(frozen=True)
class Field:
    """A field: its type, meaning and unit, and the attribute of a sealed recording that it repeats."""

    type: Literal["text", "number", "day"]
    description: str
    unit: str = ""
    attribute: str = ""


LABELS = {name: Field("text", field.description or "", "", name) for name, field in Labels.model_fields.items()}
PARTICIPANT = LABELS.pop("participant")
"""Labels of a test, as its recording repeats them; the participant stands apart."""
FIELDS: dict[str, Field] = {
    "participant": PARTICIPANT,
    "day": Field("day", "day of the session, UTC"),
    **LABELS,
    "name": Field("text", "name of the file"),
    "origin": Field("text", "the DATA in which it was found"),
    "record_id": Field("text", "id of the recording, where it says one", "", "recording_id"),
    "test_id": Field("text", "id of the test", "", "test_id"),
    "outcome": Field("text", "how the test ended: completed, stopped, fault", "", "outcome"),
    "duration_s": Field("number", "from the first sample to the last", "s"),
    "rate_hz": Field("number", "samples a second", "Hz"),
    "bytes": Field("number", "size of the file", "B"),
}
"""Every field that `--select` may name. A field is absent from a mapping as long as it is unknown, and None where the
record says nothing of it."""
COLUMNS = ", ".join(f":{name} AS {name}" for name in FIELDS)
EXAMPLE = 'Give something like participant = "P001" and duration_s > 20.'
MAX_CHARACTERS = 2000


class Selection:
    """Select records by a condition; an empty one selects all.

    Raises CohortError: it is no condition, or names an unknown field.
    """

    def __init__(self, text: str = "") -> None:
        self.text = " ".join(text.split())
        if len(self.text) > MAX_CHARACTERS:
            raise CohortError(f"--select: more than {MAX_CHARACTERS} characters. Give a folder of the records instead.")
        self._named = [name for name in FIELDS if re.search(rf"\b{name}\b", self.text)]
        try:
            self(dict.fromkeys(FIELDS))
        except (sqlite3.Error, UnicodeEncodeError, ValueError) as error:
            fields = f"The fields are {', '.join(FIELDS)}. " if "column" in str(error) else ""
            raise CohortError(f"--select: {' '.join(str(error).split())}. {fields}{EXAMPLE}") from None

    def __call__(self, fields: Mapping[str, Any]) -> bool | None:
        """Return whether a record is selected; None while a field is unknown that the condition names."""
        if any(name not in fields for name in self._named):
            return None
        values = {name: fields.get(name) for name in FIELDS}
        values = {name: value.isoformat() if isinstance(value, date) else value for name, value in values.items()}
        statement = f"SELECT ({self.text}) FROM (SELECT {COLUMNS})" if self.text else "SELECT 1"
        return bool(_database().execute(statement, values).fetchone()[0])


@cache
def _database() -> sqlite3.Connection:
    """Return the process's connection to an empty database, which evaluates conditions."""
    database = sqlite3.connect(":memory:", check_same_thread=False)
    database.set_authorizer(_authorize)
    return database


def _authorize(action: int, _argument: str | None, name: str | None, *_: str | None) -> int:
    """Allow comparisons and LIKE alone: a run must not depend on a clock, nor end in a function that never ends."""
    function = action == sqlite3.SQLITE_FUNCTION and name == "like"
    return (
        sqlite3.SQLITE_OK if function or action in (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ) else sqlite3.SQLITE_DENY
    )


def parse_day(text: str) -> date | None:
    """Return the day of a date or time in ISO 8601; None if it is neither."""
    try:
        return date.fromisoformat(text[:10])
    except ValueError:
        return None

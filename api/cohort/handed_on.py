"""What an export hands to its formats: whose record it is, what becomes of its days, and what a format must do."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta
from typing import Any, Protocol

from stimrig.api.cohort.export_state import State
from stimrig.api.cohort.opened import Opened

UNDATED = "undated"
ERRORS = "errors.csv"


class NoExport(Exception):
    """A record that cannot be exported: kind and reason, for its line of `errors.csv`."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind, self.reason = kind, reason


@dataclass(frozen=True)
class Days:
    """What becomes of dates: kept, moved by some days, or left out."""

    hide: bool = False
    shift_days: int = 0

    @property
    def kept(self) -> bool:
        """Whether they are as they were."""
        return not self.hide and not self.shift_days

    def begun(self, utc: str | None) -> str | None:
        """A time (ISO 8601) as it may be told."""
        if self.hide or not utc:
            return None
        try:
            return (datetime.fromisoformat(utc) + timedelta(days=self.shift_days)).isoformat()
        except (ValueError, OverflowError):
            return None

    def session(self, day: str | None, participant: str, salt: str) -> str:
        """Label of a session: its day in digits, or what stands for it."""
        if not day:
            return UNDATED
        if self.hide:
            return "s" + hmac.new(salt.encode(), f"{participant}\0{day}".encode(), hashlib.sha256).hexdigest()[:10]
        return (date.fromisoformat(day) + timedelta(days=self.shift_days)).strftime("%Y%m%d")


@dataclass(frozen=True)
class Who:
    """Whose record it is, and how it is called.

    Attributes
    ----------
    key : str
        Letters and digits that no other record has: it names files.
    """

    participant: str
    label: str
    session: str
    record_id: str
    key: str
    begun_utc: str | None


Put = Callable[[str], Any]
"""Gives a file to write at a place, which takes it as a whole or not at all."""


class Writer(Protocol):
    """A format: a module."""

    NAME: str

    def write(self, record: Opened, who: Who, put: Put) -> dict[str, Any]:
        """Write a record's files; its row for `finish`. Raises NoExport."""
        ...

    def finish(self, state: State, put: Put) -> None:
        """Write what is made of all records."""
        ...


def hidden(record: Opened, days: Days) -> Opened:
    """The record without what would tell the days that are not to be told."""
    if days.kept:
        return record
    told = {"address", "name", "origin", "reason", "configuration", "events", "laid", "day", "begun_utc", "test_id"}
    return replace(record, about={key: value for key, value in record.about.items() if key not in told}, notes=())

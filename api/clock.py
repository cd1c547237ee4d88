"""Time as a label (UTC) and for decisions (monotonic); injected, so that tests can set it."""

from __future__ import annotations

import os
import time
from contextvars import ContextVar
from datetime import UTC, datetime, timedelta
from pathlib import Path


class Clock:
    """The system clock."""

    def unix_s(self) -> float:
        """Seconds since 1970, UTC."""
        return time.time()

    def monotonic_s(self) -> float:
        """Seconds that never run backwards."""
        return time.monotonic()

    def utc(self) -> str:
        """Now, as an ISO 8601 label."""
        return utc_label(self.unix_s())

    def start_of_day_utc(self, days: int = 0) -> str:
        """The last midnight where the service stands, or so many days later, as an ISO 8601 label in UTC."""
        today = datetime.fromtimestamp(self.unix_s()).date()
        midnight = datetime.combine(today + timedelta(days=days), datetime.min.time())
        return utc_label(midnight.astimezone().timestamp())

    def end_of_day_utc(self) -> str:
        """The next midnight where the service stands, as an ISO 8601 label in UTC."""
        return self.start_of_day_utc(1)


def utc_label(unix_s: float) -> str:
    """An ISO 8601 label, to the millisecond."""
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def unix_of(label: str) -> float:
    """Seconds since 1970 of an ISO 8601 label."""
    return datetime.fromisoformat(label).timestamp()


def local_day(label: str) -> str:
    """A UTC label's day where the service stands: 2026-11-21."""
    return datetime.fromtimestamp(unix_of(label)).date().isoformat()


def set_zone(name: str) -> None:
    """Let this process show times, and end its days, as in this time zone."""
    os.environ["TZ"] = name
    time.tzset()


def zone_name() -> str:
    """Return the name of the display time zone, as Europe/Berlin; empty where the machine has none."""
    if named := os.environ.get("TZ", "").removeprefix(":"):
        return named
    _, mark, name = os.path.realpath("/etc/localtime").partition("/zoneinfo/")
    written = Path("/etc/timezone")
    return name if mark else written.read_text("utf-8").strip() if written.is_file() else ""


request_received_s: ContextVar[float] = ContextVar("request_received_s")
"""When the request that is being answered came in, on the monotonic clock."""

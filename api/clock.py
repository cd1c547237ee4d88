"""Time as a label (UTC) and for decisions (monotonic); injected, so that tests can set it."""

from __future__ import annotations

import time
from contextvars import ContextVar
from datetime import UTC, datetime, timedelta


class Clock:
    """The world's clock."""

    def unix_s(self) -> float:
        """Seconds since 1970, UTC."""
        return time.time()

    def monotonic_s(self) -> float:
        """Seconds that never run backwards."""
        return time.monotonic()

    def utc(self) -> str:
        """Now, as an ISO 8601 label."""
        return utc_label(self.unix_s())

    def end_of_day_utc(self) -> str:
        """The next midnight where the service stands, as an ISO 8601 label in UTC."""
        today = datetime.fromtimestamp(self.unix_s()).astimezone()
        midnight = datetime.combine(today.date() + timedelta(days=1), datetime.min.time())
        return utc_label(midnight.astimezone().timestamp())


def utc_label(unix_s: float) -> str:
    """An ISO 8601 label, to the millisecond."""
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def unix_of(label: str) -> float:
    """Seconds since 1970 of an ISO 8601 label."""
    return datetime.fromisoformat(label.replace("Z", "+00:00")).timestamp()


asked_s: ContextVar[float] = ContextVar("asked_s")
"""When the request that is being answered came in, on the monotonic clock."""

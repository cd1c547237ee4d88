"""Time as a label (UTC) and for decisions (monotonic); injected, so that tests can set it."""

from __future__ import annotations

import time
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

"""Time as a label (UTC) and for decisions (monotonic); injected, so that tests can set it."""

from __future__ import annotations

import time
from datetime import UTC, datetime


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


def utc_label(unix_s: float) -> str:
    """An ISO 8601 label, to the millisecond."""
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

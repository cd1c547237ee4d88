"""What is public and will go: since when, when it goes, what to use instead; and how each of them is told.

Nothing public goes before it was told for at least one minor version (docs/versions.md). An entry stands here from the
version that deprecates until the one in which it is gone, and one version longer, for `tests/frozen/public.toml`.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from email.utils import format_datetime


@dataclass(frozen=True)
class Deprecation:
    """One name.

    `name`: as in `tests/frozen/public.toml`, `part/name` or `part/name item`, e.g. `verbs/fit --fit-on`,
    `routes/GET /v1/rig`, `python/read`. `since`, `gone_in`: versions. `use`: what to use instead. `since_on`,
    `gone_on`: dates, which a route's headers need.
    """

    name: str
    since: str
    gone_in: str
    use: str
    since_on: date | None = None
    gone_on: date | None = None

    def line(self) -> str:
        """For people."""
        shown = self.name.partition("/")[2]
        return f"{shown} is deprecated since {self.since} and gone in {self.gone_in}; use {self.use}"


OWN_EFFECTS = Deprecation("python/import identify", "1.0", "2.0", "from stimrig.effects import …")
"""In a file with an effect of one's own."""
DEPRECATIONS: tuple[Deprecation, ...] = (OWN_EFFECTS,)


def warn(found: Deprecation, stacklevel: int = 3) -> None:
    """Tell whoever calls a deprecated name from Python."""
    warnings.warn(found.line(), DeprecationWarning, stacklevel=stacklevel)


def of_python(name: str) -> Deprecation | None:
    """The deprecation of a name of `import stimrig`."""
    return next((one for one in DEPRECATIONS if one.name == f"python/{name}"), None)


def of_command(words: Sequence[str]) -> list[str]:
    """A line for each deprecated verb and option in a command line."""
    verb = next((word for word in words if not word.startswith("-")), "")
    given = {f"verbs/{verb}", *(f"verbs/{verb} {word.partition('=')[0]}" for word in words)}
    return [one.line() for one in DEPRECATIONS if one.name in given]


def headers_of(method: str, path: str) -> dict[str, str]:
    """What an answer of a deprecated route says of it: `Deprecation` (RFC 9745) and `Sunset` (RFC 8594)."""
    for one in DEPRECATIONS:
        known, _, template = one.name.removeprefix("routes/").partition(" ")
        pattern = re.sub(r"\\\{\w+\\\}", "[^/]+", re.escape(template))
        if one.name.startswith("routes/") and known == method and re.fullmatch(pattern, path):
            since, gone = _midnight(one.since_on), _midnight(one.gone_on)
            return {"Deprecation": f"@{int(since.timestamp())}", "Sunset": format_datetime(gone, usegmt=True)}
    return {}


def _midnight(day: date | None) -> datetime:
    if day is None:
        raise ValueError("a deprecated route needs `since_on` and `gone_on`")
    return datetime(day.year, day.month, day.day, tzinfo=UTC)

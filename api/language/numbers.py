"""Numbers and times as the page's language writes them; units stay SI."""

from __future__ import annotations

import re
from datetime import datetime, timedelta

from babel.dates import format_date

from stimrig.api.language.words import locale

_POINT = re.compile(r"(?<=\d)\.(?=\d)")


def decimal() -> str:
    """The decimal sign."""
    return str(locale().number_symbols["latn"]["decimal"])


def separators() -> str:
    """For plotly: the decimal sign, then what stands between thousands (a thin space, in any language)."""
    return decimal() + "\u202f"


def localised(text: str) -> str:
    """A text with the decimal points of its numbers as the language writes them; times and versions are not numbers."""
    return text if decimal() == "." else _POINT.sub(decimal(), text)


def _local(label: str) -> datetime:
    return datetime.fromisoformat(label.replace("Z", "+00:00")).astimezone()


def day(label: str | None, year: bool = True) -> str:
    """A UTC label as a day, where this machine stands: 12 Nov 2026."""
    if not label:
        return "–"
    pattern = "dd MMM yyyy" if year else "d MMM"
    return format_date(_local(label).date(), pattern, locale=locale())


def when(label: str | None) -> str:
    """A UTC label in the machine's local time, to the minute."""
    return f"{day(label)}, {_local(label):%H:%M}" if label else "–"


def until(label: str | None) -> str:
    """As `when`, of an end: midnight is shown as the last minute of the day that it ends."""
    if label and (end := _local(label)).strftime("%H:%M") == "00:00":
        label = (end - timedelta(minutes=1)).isoformat()
    return when(label)


def clock(label: str | None) -> str:
    """A UTC label as the time of day where this machine stands, to the second."""
    return f"{_local(label):%H:%M:%S}" if label else "–"


def zone(label: str) -> str:
    """The zone that `when` writes in at that time: UTC+1."""
    offset = _local(label).utcoffset() or timedelta(0)
    minutes = round(offset.total_seconds() / 60)
    sign, (hours, rest) = "+" if minutes >= 0 else "−", divmod(abs(minutes), 60)
    return "UTC" if not minutes else f"UTC{sign}{hours}" + (f":{rest:02d}" if rest else "")

"""Write UTC labels as the days and times that a clock on this machine's wall shows."""

from __future__ import annotations

from datetime import datetime, timedelta


def _local(label: str) -> datetime:
    return datetime.fromisoformat(label.replace("Z", "+00:00")).astimezone()


def day(label: str | None, year: bool = True) -> str:
    """Write a UTC label as a local day: 12 Nov 2026."""
    if not label:
        return "–"
    local = _local(label)
    return f"{local:%d %b %Y}" if year else f"{local.day} {local:%b}"


def when(label: str | None) -> str:
    """Write a UTC label in local time, to the minute."""
    return f"{day(label)}, {_local(label):%H:%M}" if label else "–"


def until(label: str | None) -> str:
    """Write the end of a period as `when` does; midnight is shown as the last minute of the day that it ends."""
    if label and (end := _local(label)).strftime("%H:%M") == "00:00":
        label = (end - timedelta(minutes=1)).isoformat()
    return when(label)


def clock(label: str | None) -> str:
    """Write a UTC label as the local time of day, to the second."""
    return f"{_local(label):%H:%M:%S}" if label else "–"


def zone(label: str) -> str:
    """Name the zone in which `when` writes at that time: UTC+1."""
    offset = _local(label).utcoffset() or timedelta(0)
    minutes = round(offset.total_seconds() / 60)
    sign, (hours, rest) = "+" if minutes >= 0 else "−", divmod(abs(minutes), 60)
    return "UTC" if not minutes else f"UTC{sign}{hours}" + (f":{rest:02d}" if rest else "")

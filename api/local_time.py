"""Write UTC labels as the days and times that a clock on this machine's wall shows."""

from __future__ import annotations

from datetime import datetime, timedelta


def _local(label: str) -> datetime:
    return datetime.fromisoformat(label).astimezone()


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
    offset = f"{_local(label):%z}"
    hours, minutes = int(offset[1:3]), offset[3:5]
    sign = "−" if offset[0] == "-" else "+"
    return "UTC" if offset[1:] == "0000" else f"UTC{sign}{hours}" + ("" if minutes == "00" else f":{minutes}")

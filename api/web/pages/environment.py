"""The templates, and how numbers and times are written in them: for pages of the service and for reports as files."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from api.charts.config import CHART_CONFIG

HERE = Path(__file__).parent

environment = Environment(
    loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
    lstrip_blocks=True,
)  # fmt: skip


def number(value: float | None, digits: int = 1, unit: str = "") -> str:
    """A number for people; a dash where there is none."""
    if value is None:
        return "–"
    text = f"{value:.{digits}f}".replace("-", "−")
    return f"{text} {unit}" if unit else text


def when(label: str | None) -> str:
    """A UTC label in the machine's local time, to the minute."""
    if not label:
        return "–"
    return datetime.fromisoformat(label.replace("Z", "+00:00")).astimezone().strftime("%d %b %Y, %H:%M")


def clock(label: str | None) -> str:
    """A UTC label as the time of day where this machine stands, to the second."""
    if not label:
        return "–"
    return datetime.fromisoformat(label.replace("Z", "+00:00")).astimezone().strftime("%H:%M:%S")


def figures(value: float | None) -> str:
    """A number to three significant figures, without powers of ten where they can be done without."""
    if value is None:
        return "–"
    if value == 0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:.{digits}f}" if digits <= 6 else f"{value:.2g}"
    return text.replace("-", "−")


environment.filters["number"] = number
environment.filters["figures"] = figures
environment.filters["when"] = when
environment.filters["clock"] = clock
environment.globals["chart_config"] = CHART_CONFIG

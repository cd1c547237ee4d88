"""What a chart says under the pointer: quantity, unit, and as many digits as the measurement carries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from stimrig.api.language import localised

TORQUE, RESIDUAL, WIDTH, SHARE = "%{y:.2f} N·m", "%{y:+.3f} N·m", "%{y:.0f} µs", "%{y:.3f}"
FACTOR = "%{y:.2f}"
BESIDE = " · %{customdata}"
AT_TIME = {"unifiedhovertitle": {"text": "%{x:.2f} s"}}
AT_WIDTH = {"unifiedhovertitle": {"text": "%{x:.0f} µs"}}
AT_ANGLE = {"unifiedhovertitle": {"text": "%{x:.0f}°"}}
QUIET = {"hoverinfo": "skip"}


def says(words: str, value: str, customdata: Sequence[Any] | None = None) -> dict[str, Any]:
    """A trace's hover text."""
    template = {"hovertemplate": f"{words} {value}<extra></extra>"}
    return template if customdata is None else {**template, "customdata": list(customdata)}


def with_band(words: str, value: str, x: Sequence[float], band: dict[str, Any], along: str) -> dict[str, Any]:
    """A curve's hover text with the half width of its band, which has points of its own; `along`: their name."""
    if not band:
        return says(words, value)
    halves = [(high - low) / 2 for low, high in zip(band["whole_lower"], band["whole_upper"], strict=True)]
    return with_halves(words, value, [on(at, band[along], halves) for at in x])


def with_halves(words: str, value: str, halves: Sequence[float]) -> dict[str, Any]:
    """A curve's hover text with the half width of its band at each of its points; without it if there are none."""
    if not halves:
        return says(words, value)
    return says(words, f"{value} ± %{{customdata}}", [localised(f"{half:.2f}") for half in halves])


def on(at: float, x: Sequence[float], y: Sequence[float]) -> float:
    """Linear interpolation; the last value beyond the end."""
    for index in range(1, len(x)):
        if at <= x[index]:
            return y[index - 1] + (at - x[index - 1]) / (x[index] - x[index - 1]) * (y[index] - y[index - 1])
    return y[-1]


def segments_at(time_s: Sequence[float], segments: Sequence[dict[str, Any]], words: Callable[[str], str]) -> list[str]:
    """What the segment at each time is called."""
    found, at = [], 0
    names = [words(segment["name"]) for segment in segments] or [""]
    for moment in time_s:
        while at < len(segments) - 1 and moment >= segments[at + 1]["start_s"]:
            at += 1
        found.append(names[at])
    return found

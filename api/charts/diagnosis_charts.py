"""Figures of what is missing in a model: the residual with its worst places, signatures, the falling error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import Axis, Band, Curve, Figure, Label, Rule, Shade
from stimrig.api.charts.model_charts import segment_marks
from stimrig.api.models import explanation
from stimrig.identify.healing import looks_like_noise
from stimrig.identify.yardstick import floor_nm


def diagnosis_figures(
    comparison: dict[str, Any] | None,
    segments: list[dict[str, Any]],
    view: dict[str, Any] | None,
    signatures: dict[str, Any],
    rows: list[dict[str, Any]],
) -> dict[str, Figure]:
    """Return all figures of the section by name."""
    figures = {"falling": falling(rows)} if len(rows) > 1 else {}
    if comparison and comparison.get("series"):
        figures["residual"] = residual(comparison, segments, view["places"] if view else places_of(comparison))
    for entry in view["missing"] if view else []:
        if entry["id"] in signatures:
            figures[f"signature-{entry['id']}"] = signature(signatures["time_s"], signatures[entry["id"]])
    return figures | free_effects(view["free"] if view else [])


def free_effects(entries: list[dict[str, Any]]) -> dict[str, Figure]:
    """Return the figures of free effects by name."""
    return {f"free-{entry['id']}": free_effect(entry) for entry in entries}


def places_of(comparison: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the worst places before a diagnosis is there."""
    if looks_like_noise(comparison):
        return []
    return [explanation.place(entry, number) for number, entry in enumerate(comparison.get("where") or [], start=1)]


def place_labels(places: Sequence[dict[str, Any]]) -> tuple[Label, ...]:
    """Return the number of each place, at its top."""
    return tuple(
        Label((place["start_s"] + place["end_s"]) / 2, str(place["number"]), "good" if place.get("healed") else "worst")
        for place in places
    )


def residual(comparison: dict[str, Any], segments: list[dict[str, Any]], places: Sequence[dict[str, Any]]) -> Figure:
    """Return measurement minus model over time, the noise band, the worst places marked with their numbers."""
    series = comparison["series"]
    time_s, noise_nm = series["time_s"], series.get("noise_band_nm") or 0.0
    shades, labels = segment_marks(segments)
    shades += (Shade("noise-band", low=-noise_nm, high=noise_nm),)
    shades += tuple(Shade("worst-band", place["start_s"], place["end_s"]) for place in places)
    line = Curve(time_s, series["residual_nm"], "measured − model", "residual", 0.9, value=fig.RESIDUAL,
                 notes=fig.segment_names(time_s, segments))  # fmt: skip
    x = Axis("Time (s)", fig.AT_TIME, (time_s[0], time_s[-1]))
    labels += place_labels(places)
    return Figure(x, (Axis("Measured − model (N·m)"),), (line,), shades=shades, labels=labels, height=320)


def signature(time_s: list[float], effect: dict[str, list[float]]) -> Figure:
    """Return what is left without an effect, and what adding it explains of that."""
    lines = (
        Curve(time_s, effect["seen_nm"], "seen: left without it", "measured", 3.2, value=fig.RESIDUAL),
        Curve(time_s, effect["expected_nm"], "expected: what it explains", "model", 1.8, value=fig.RESIDUAL),
    )
    x = Axis("Time (s)", fig.AT_TIME, (time_s[0], time_s[-1]))
    return Figure(x, (Axis("Torque (N·m)"),), lines, height=250)


def free_effect(entry: dict[str, Any]) -> Figure:
    """Return what a free effect does: its curves, each with its band."""
    lines, bands = [], []
    for number, (name, curve) in enumerate(entry["lines"].items()):
        colour = ("model", "measured")[number % 2]
        lines.append(Curve(entry["at"], curve["value"], name, colour, 2.2, value=fig.SHARE))
        bands.append(Band(entry["at"], curve["lower"], curve["upper"], colour="series-band" if number else "model-band",
                          listed=not number))  # fmt: skip
    return Figure(Axis(entry["driver"]), (Axis(entry["axis"]),), tuple(lines), tuple(bands), height=270)


def falling(rows: list[dict[str, Any]]) -> Figure:
    """Return the error over the versions, with the noise as the line to fall to."""
    numbers = list(range(len(rows)))
    current = [number for number in numbers if rows[number]["current"]]
    lines = []
    for key, label, colour, marker in (
        ("rms_nm", "fitted pulses", "measured", "circle"),
        ("held_out_rms_nm", "held-out pulses", "model", "diamond"),
    ):
        values = [row[key] for row in rows]
        if key == "rms_nm" or any(value is not None for value in values):
            lines.append(Curve(numbers, values, label, colour, 2.2, marker=marker, value=fig.ERROR))
            lines.append(Curve(current, [values[number] for number in current], "", colour, 0, marker=marker, size=13,
                               listed=False))  # fmt: skip
    repeats = rows[-1].get("repetition") or {}
    between = "scatter at rest" if repeats.get("found_by") == "estimate" else "between repeats"
    levels = ((rows[-1].get("noise_sd_nm"), "noise", False), (floor_nm(repeats), between, True))
    rules = tuple(Rule(level, f"{name} {level:.3f} N·m", right=right) for level, name, right in levels if level)
    ticks = [(number, f"{number + 1}. {row['label']}") for number, row in enumerate(rows)]
    x = Axis("Version", limits=(-0.4, len(rows) - 0.6), ticks=ticks)
    return Figure(x, (Axis("Error (N·m)", from_zero=True),), tuple(lines), rules=rules, height=320)

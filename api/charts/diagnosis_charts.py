"""Figures of what is missing in a model (where the error sits, signatures, the falling error), and of the story."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stimrig.api.charts.figure import Axis, Figure, Line, Mark, Note, Rule, Shade, time_axis
from stimrig.api.charts.model_charts import broken_at_pauses, free_effects, segment_marks
from stimrig.api.models import explanation
from stimrig.identify.effects import registry
from stimrig.identify.healing import looks_like_noise
from stimrig.identify.yardstick import floor_nm

AROUND_S = 1.0
"""Length of the record on each side of the place that the story shows close up, s."""
Places = Sequence[Mapping[str, Any]]


def diagnosis_figures(
    comparison: dict[str, Any] | None, segments: list[dict[str, Any]], view: dict[str, Any] | None,
    signatures: dict[str, Any], rows: list[dict[str, Any]],
) -> dict[str, Figure]:  # fmt: skip
    """Return all figures of the section by name."""
    figures = {"falling": falling(rows)} if len(rows) > 1 else {}
    if comparison and comparison.get("series"):
        figures["residual"] = residual(comparison, segments, view["places"] if view else places_of(comparison))
    for entry in view["missing"] if view else []:
        if entry["id"] in signatures:
            figures[f"signature-{entry['id']}"] = signature(signatures["time_s"], signatures[entry["id"]])
    return figures | free_effects(view["free"] if view else [])


def places_of(comparison: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the worst places before a diagnosis is there."""
    if looks_like_noise(comparison):
        return []
    return [explanation.place(entry, number) for number, entry in enumerate(comparison.get("where") or [], start=1)]


def _marks(places: Places) -> list[Mark]:
    """Return a shade and a number for each place."""
    marks: list[Mark] = []
    for place in places:
        ground, start_s, end_s = "good" if place.get("healed") else "worst", place["start_s"], place["end_s"]
        marks.append(Shade("healed-band" if place.get("healed") else "worst-band", start_s, end_s))
        marks.append(Note((start_s + end_s) / 2, str(place["number"]), ground))
    return marks


def residual(comparison: dict[str, Any], segments: list[dict[str, Any]], places: Places) -> Figure:
    """Return measurement minus model over time, the noise band, the worst places marked with their numbers."""
    series = comparison["series"]
    time_s, noise_nm = series["time_s"], series.get("noise_band_nm") or 0.0
    line = Line(time_s, series["residual_nm"], "measured − model", "residual", 0.9)
    marks = [*segment_marks(segments), Shade("noise-band", -noise_nm, noise_nm, 0), *_marks(places), line]
    return Figure(time_axis(time_s[0], time_s[-1]), [Axis("Measured − model (N·m)")], marks, 320)


def signature(time_s: list[float], effect: dict[str, list[float]]) -> Figure:
    """Return what is left without an effect, and what adding it explains of that."""
    lines = (
        Line(time_s, effect["seen_nm"], "seen: left without it", "measured", 3.2),
        Line(time_s, effect["expected_nm"], "expected: what it explains", "model", 1.8),
    )
    return Figure(time_axis(time_s[0], time_s[-1]), [Axis("Torque (N·m)")], lines, 250)


def falling(rows: list[dict[str, Any]]) -> Figure:
    """Return the error over the versions, with the noise as the line to fall to."""
    numbers = list(range(len(rows)))
    marks: list[Mark] = []
    for key, label, colour, marker in (
        ("rms_nm", "fitted pulses", "measured", "o"),
        ("held_out_rms_nm", "held-out pulses", "model", "D"),
    ):
        values = [row[key] for row in rows]
        if key == "rms_nm" or any(value is not None for value in values):
            marks.append(Line(numbers, values, label, colour, 2.2, marker=marker))
            marks += [Line([number], [values[number]], "", colour, 0, marker=marker, size=13)
                      for number in numbers if rows[number]["current"]]  # fmt: skip
    repeats = rows[-1].get("repetition") or {}
    between = "scatter at rest" if repeats.get("found_by") == "estimate" else "between repeats"
    levels = ((rows[-1].get("noise_sd_nm"), "noise", False), (floor_nm(repeats), between, True))
    marks += [Rule(level, f"{name} {level:.3f} N·m", right=right) for level, name, right in levels if level]
    ticks = [(number, f"{number + 1}. {row['label']}") for number, row in enumerate(rows)]
    x = Axis("Version", (-0.4, len(rows) - 0.6), ticks)
    return Figure(x, [Axis("Error (N·m)", from_zero=True)], marks, 320)


# ---- the story of a model's improvement -----------------------------------------------------------------------------


def story_figures(story: dict[str, Any], before: dict[str, Any], after: dict[str, Any]) -> dict[str, Figure]:
    """Return the figures of the story.

    `story`: as `stimrig.api.models.story` gives it. `before`, `after`: ``curves`` and ``comparison`` of the first model
    and of the last one; the same where nothing was added.
    """
    places, rows = story["places"], story["rows"]
    figures = {"story-torque": side_by_side(before, after, places)}
    if places:
        figures["story-place"] = side_by_side(before, after, places[:1], close=True)
    if len(rows) > 1:
        figures["falling"] = falling(rows)
    return figures | free_effects(story["why"]["free"] if story["why"] else [])


def story_names() -> list[str]:
    """Return every name that `story_figures` may give."""
    free = [f"{kind}-{effect.id}" for effect in registry().values() if effect.shape for kind in ("free", "course")]
    return ["story-torque", "story-place", "falling", *free]


def side_by_side(before: dict[str, Any], after: dict[str, Any], places: Places, close: bool = False) -> Figure:
    """Return torque measured, and predicted before and after; below it what is left before and after.

    With `close` only what is around the first place is drawn.
    """
    curves, changed = before["curves"], before is not after
    start_s, end_s, marks = curves["time_s"][0], curves["time_s"][-1], []
    if close:
        start_s, end_s = max(start_s, places[0]["start_s"] - AROUND_S), min(end_s, places[0]["end_s"] + AROUND_S)
    else:
        marks = segment_marks(curves["segments"])
    noise_nm = after["comparison"]["series"].get("noise_band_nm") or 0.0
    marks += [Shade("noise-band", -noise_nm, noise_nm, 1), *_marks(places)]

    def line(data: dict[str, Any], key: str, label: str, colour: str, width: float, **more: Any) -> Line:
        series = broken_at_pauses(data)
        rows = [row for row in zip(series["time_s"], series[key], strict=True) if start_s <= row[0] <= end_s]
        return Line([row[0] for row in rows], [row[1] for row in rows], label, colour, width, **more)

    predicted, below = "predicted_torque_nm", {"panel": 1, "listed": False}
    marks.append(line(curves, "torque_nm", "measured", "measured", 3.2))
    if changed:
        marks.append(line(curves, predicted, "model at first", "series-2", 1.6, dash="dot"))
        marks.append(line(before["comparison"]["series"], "residual_nm", "left at first", "series-2", 0.9, **below))
    marks.append(line(after["curves"], predicted, "model at last" if changed else "model", "model", 1.8))
    marks.append(line(after["comparison"]["series"], "residual_nm", "left", "residual", 1.0, **below))
    panels = [Axis("Torque (N·m)"), Axis("Residual (N·m)")]
    return Figure(time_axis(start_s, end_s), panels, marks, 420, (0.6, 0.35))

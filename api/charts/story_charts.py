"""Figures of how a model was improved: before and after on the same axes, and the place where it failed, close up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stimrig.api.charts import figure as fig
from stimrig.api.charts.diagnosis_charts import falling, place_labels
from stimrig.api.charts.drawing import Figures
from stimrig.api.charts.figure import Axis, Curve, Figure, Shade, Value
from stimrig.api.charts.model_charts import broken_at_pauses, segment_marks

AROUND_S = 1.0
"""Length of the record on each side of the place shown close up, s."""


def story_figures(story: dict[str, Any], before: dict[str, Any], after: dict[str, Any], at: str = "") -> Figures:
    """Return the figures of the story.

    `story`: as `stimrig.api.models.story` gives it. `before`, `after`: ``curves`` and ``comparison`` of the first model
    and of the last one; the same where nothing was added. `at`: as `Figures` takes it.
    """
    places, rows = story["places"], story["rows"]
    figures = {"story-torque": side_by_side(before, after, places)}
    if places:
        figures["story-place"] = side_by_side(before, after, places[:1], close=True)
    if len(rows) > 1:
        figures["falling"] = falling(rows)
    return Figures(figures, at, captions(story))


def side_by_side(
    before: dict[str, Any], after: dict[str, Any], places: Sequence[dict[str, Any]], close: bool = False
) -> Figure:
    """Return torque measured, and predicted before and after; below it what is left before and after.

    With `close` only what is around the first place is drawn.
    """
    curves, changed = before["curves"], before is not after
    start_s, end_s = curves["time_s"][0], curves["time_s"][-1]
    if close:
        start_s, end_s = max(start_s, places[0]["start_s"] - AROUND_S), min(end_s, places[0]["end_s"] + AROUND_S)
    shades, labels = ((), ()) if close else segment_marks(curves["segments"])
    noise_nm = after["comparison"]["series"].get("noise_band_nm") or 0.0
    shades += (Shade("noise-band", low=-noise_nm, high=noise_nm, panel=1),)
    shades += tuple(
        Shade("healed-band" if place["healed"] else "worst-band", place["start_s"], place["end_s"]) for place in places
    )

    def line(data: dict[str, Any], key: str, label: str, colour: str, width: float, value: Value, **more: Any) -> Curve:
        x, y = _between(data, key, start_s, end_s)
        return Curve(x, y, label, colour, width, value=value, **more)

    def residual_line(model: dict[str, Any], label: str, colour: str, width: float) -> Curve:
        series = model["comparison"]["series"]
        return line(series, "residual_nm", label, colour, width, fig.RESIDUAL, panel=1, listed=False)

    lines = [line(curves, "torque_nm", "measured", "measured", 3.2, fig.TORQUE)]
    if changed:
        lines += [line(curves, "predicted_torque_nm", "model at first", "series-2", 1.6, fig.TORQUE, dash="dot"),
                  residual_line(before, "left at first", "series-2", 0.9)]  # fmt: skip
    last = "model at last" if changed else "model"
    lines += [line(after["curves"], "predicted_torque_nm", last, "model", 1.8, fig.TORQUE),
              residual_line(after, "left at last" if changed else "residual", "residual", 1.0)]  # fmt: skip
    panels = (Axis("Torque (N·m)", share=0.6), Axis("Residual (N·m)", share=0.35))
    x = Axis("Time (s)", fig.AT_TIME, (start_s, end_s))
    return Figure(x, panels, tuple(lines), shades=shades, labels=labels + place_labels(places), height=420)


def _between(data: dict[str, Any], key: str, start_s: float, end_s: float) -> tuple[list[float], list[float | None]]:
    """Return a curve between two times, broken where the recording pauses."""
    series = broken_at_pauses({"time_s": data["time_s"], "torque_nm": data[key]})
    pairs = [pair for pair in zip(series["time_s"], series["torque_nm"], strict=True) if start_s <= pair[0] <= end_s]
    return [time_s for time_s, _value in pairs], [value for _time_s, value in pairs]


def captions(narrative: dict[str, Any]) -> dict[str, str]:
    """Return what stands below each figure, with its numbers."""
    rows, noise = narrative["rows"], f"{narrative['noise_sd_nm']:.3g}"
    first, last = (f"{row[narrative['error']]:.3g}" for row in (rows[0], rows[-1]))
    words = {
        "story-torque": ("Torque measured and predicted in free run from the pulse widths (top), and measured minus "
                          f"predicted (bottom); grey band: 95 % of the noise of {noise} N·m. Error {first} N·m."),
        "falling": ("Error of each version; dashed: the noise of a sample, and what differs between repeats of the "
                     "same pulses, or where nothing repeats, how the torque scatters at rest."),
    }  # fmt: skip
    if len(rows) > 1:
        words["story-torque"] += f" Error of the last model {last} N·m."
    if narrative["places"]:
        words["story-place"] = f"The worst place close up: {narrative['places'][0]['words'].rstrip('.')}."
    return words

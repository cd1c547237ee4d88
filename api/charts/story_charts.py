"""Figures of how a model was improved: before and after on the same axes, and the place where it failed, close up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stimrig.api.charts import figure as fig
from stimrig.api.charts.diagnosis_charts import falling, number_place
from stimrig.api.charts.figure import INK, MEASURED, MODEL, TOOLBAR_PX, axis, box, line, role
from stimrig.api.charts.model_charts import broken_at_pauses, segment_marks
from stimrig.api.charts.svg import Figures

BEFORE = role("series-2")
AROUND_S = 1.0
"""Of the record on each side of the place that is shown close up."""


def story_figures(told: dict[str, Any], before: dict[str, Any], after: dict[str, Any], at: str = "") -> Figures:
    """The figures of the story.

    `told`: as `stimrig.api.models.story` gives it. `before`, `after`: ``curves`` and ``comparison`` of the first model
    and of the last one; the same where nothing was added. `at`: as `Figures` takes it.
    """
    places, rows = told["places"], told["rows"]
    figures = {"story-torque": side_by_side(before, after, places)}
    if places:
        figures["story-place"] = side_by_side(before, after, places[:1], close=True)
    if len(rows) > 1:
        figures["falling"] = falling(rows)
    return Figures(figures, at, captions(told))


def side_by_side(
    before: dict[str, Any], after: dict[str, Any], places: Sequence[dict[str, Any]], close: bool = False
) -> dict[str, Any]:
    """Torque measured, predicted before and after; and what is left before and after, on the same axes below.

    With `close` only what is around the first place is drawn.
    """
    curves, changed = before["curves"], before is not after
    time_s = curves["time_s"]
    start_s, end_s = time_s[0], time_s[-1]
    if close:
        start_s, end_s = max(start_s, places[0]["start_s"] - AROUND_S), min(end_s, places[0]["end_s"] + AROUND_S)
    shapes, labels = ([], []) if close else segment_marks(curves["segments"])
    noise_nm = (after["comparison"]["series"].get("noise_band_nm")) or 0.0
    shapes.append(box(start_s, end_s, fig.NOISE, -noise_nm, noise_nm, yref="y2"))
    for place in places:
        shapes.append(box(place["start_s"], place["end_s"], role("healed-band" if place["healed"] else "worst-band")))
        labels.append(number_place(place))
    first = [(before, "model at first", BEFORE, "dot", 1.6)] if changed else []
    data = [line(*_within(curves, "torque_nm", start_s, end_s), "measured", MEASURED, 3.2,
                 **fig.hover("measured", fig.TORQUE))]  # fmt: skip
    last = "model at last" if changed else "model"
    for model, words, colour, dash, width in [*first, (after, last, MODEL, "solid", 1.8)]:
        said = fig.hover(words, fig.TORQUE)
        x, y = _within(model["curves"], "predicted_torque_nm", start_s, end_s)
        data.append(line(x, y, words, colour, width, line={"dash": dash}, **said))
    for model, words, colour, width in [(before, "left at first", BEFORE, 0.9)] * changed + [
        (after, "left at last" if changed else "residual", INK, 1.0)
    ]:
        x, y = _within(model["comparison"]["series"], "residual_nm", start_s, end_s)
        data.append(line(x, y, words, colour, width, yaxis="y2", showlegend=False, **fig.hover(words, fig.RESIDUAL)))
    return fig.figure(
        data, height=420, shapes=shapes, annotations=labels, hoversubplots="axis",
        margin={"l": 64, "r": TOOLBAR_PX, "t": 40, "b": 48},
        xaxis=axis("Time (s)", anchor="y2", range=[start_s, end_s], **fig.AT_TIME),
        yaxis=axis("Torque (N·m)", domain=[0.42, 1.0]), yaxis2=axis("Residual (N·m)", domain=[0.0, 0.34]),
    )  # fmt: skip


def _within(found: dict[str, Any], name: str, start_s: float, end_s: float) -> tuple[list[float], list[float | None]]:
    """A curve between two times, broken where the recording pauses."""
    kept = broken_at_pauses({"time_s": found["time_s"], "torque_nm": found[name]})
    pairs = [pair for pair in zip(kept["time_s"], kept["torque_nm"], strict=True) if start_s <= pair[0] <= end_s]
    return [time_s for time_s, _value in pairs], [value for _time_s, value in pairs]


def captions(told: dict[str, Any]) -> dict[str, str]:
    """What stands below each figure, with its numbers."""
    rows, noise = told["rows"], f"{told['noise_sd_nm']:.3g}"
    first, last = (f"{row[told['error']]:.3g}" for row in (rows[0], rows[-1]))
    found = {
        "story-torque": ("Torque measured and predicted in free run from the pulse widths (top), and measured minus "
                          f"predicted (bottom); grey band: 95 % of the noise of {noise} N·m. Error {first} N·m."),
        "falling": ("Error of each version; dashed: the noise of a sample, and what differs between repeats of the "
                     "same pulses, or where nothing repeats, how the torque scatters at rest."),
    }  # fmt: skip
    if len(rows) > 1:
        found["story-torque"] += " " + f"Error of the last model {last} N·m."
    if told["places"]:
        place = told["places"][0]
        found["story-place"] = f"The worst place close up: {place['words'].rstrip('.')}."
    return found

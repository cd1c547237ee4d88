"""Curves of several models of a participant, in one chart each; a reference torque beside what a model predicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stimrig.api.charts import hover
from stimrig.api.charts.model_charts import INK, MODEL, STIMULUS, axis, band, band_of, box, layout, line
from stimrig.api.charts.palette import role
from stimrig.api.language import _

COLOURS = tuple(role(f"series-{number}") for number in range(1, 7))
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
MOST = len(COLOURS)
BANDED = 3
"""With more models than this their bands would hide one another."""


def style(number: int) -> dict[str, str]:
    """Colour and dash of the n-th model: either of them alone tells it from the others."""
    return {"colour": COLOURS[number], "dash": DASHES[number]}


def recruitment(documents: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, Any]:
    """All recruitment curves; with their bands where they are few."""
    data: list[dict[str, Any]] = []
    for number, (document, name) in enumerate(zip(documents, names, strict=True)):
        known = band_of(document, "recruitment") if len(documents) <= BANDED else None
        if known:
            pair = band(known["pulse_width_us"], known["whole_lower"], known["whole_upper"])
            pair[1] |= {"fillcolor": role("series-band"), "name": "", "showlegend": False}
            data += pair
        curve = document["recruitment"]
        data.append(_drawn(curve["pulse_width_us"], curve["torque_nm"], name, number, hover.TORQUE))
    x, y = axis(_("Pulse width (µs)"), **hover.AT_WIDTH), axis(_("Steady torque (N·m)"))
    return {"data": data, "layout": layout(height=380, xaxis=x, yaxis=y)}


def step(curves: Sequence[dict[str, Any] | None], names: Sequence[str]) -> dict[str, Any]:
    """All step responses."""
    data = [
        _drawn(found["step_response"]["time_s"], found["step_response"]["response"], name, number, hover.SHARE)
        for number, (found, name) in enumerate(zip(curves, names, strict=True))
        if found
    ]
    x, y = axis(_("Time (s)"), **hover.AT_TIME), axis(_("Share of the final torque (1)"))
    return {"data": data, "layout": layout(height=380, xaxis=x, yaxis=y)}


def _drawn(x: Sequence[float], y: Sequence[float], name: str, number: int, value: str) -> dict[str, Any]:
    return line(x, y, name, COLOURS[number], 2.2, line={"dash": DASHES[number]}, **hover.says(name, value))


def inversion(found: dict[str, Any]) -> dict[str, Any]:
    """The figure of what `POST /v1/models/{id}/widths` answers; what is out of reach is shaded."""
    step_s = 1.0 / found["pulse_rate_hz"]
    time_s = [round(k * step_s, 6) for k in range(len(found["pulse_width_us"]))]
    shades = [box(one["begin_s"], one["end_s"], role("worst-band")) for one in found["unreachable"]]
    data = [
        line(time_s, found["predicted_torque_nm"], _("predicted"), MODEL, 2.2),
        line(time_s, found["reference_torque_nm"], _("Reference"), INK, 1.4, line={"dash": "dash"}),
        line(time_s, found["pulse_width_us"], _("pulse width"), STIMULUS, 1.2, yaxis="y2", showlegend=False,
             line={"shape": "hv"}),
    ]  # fmt: skip
    return {
        "data": data,
        "layout": layout(
            height=460,
            shapes=shades,
            xaxis=axis(_("Time (s)"), range=[0.0, found["duration_s"]]),
            yaxis=axis(_("Torque above rest (N·m)"), domain=[0.42, 1.0]),
            yaxis2=axis(_("Pulse width (µs)"), domain=[0.0, 0.32], rangemode="tozero"),
        ),
    }

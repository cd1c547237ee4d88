"""A reference torque, what the model predicts for the widths found, and these, on one time axis."""

from __future__ import annotations

from typing import Any

from api.charts.model_charts import INK, MODEL, STIMULUS, axis, box, layout, line
from api.charts.palette import role
from api.language import _


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

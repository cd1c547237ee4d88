"""Figures of a model of several muscles: each muscle has one colour in all of them, the torque of all the usual one."""

from __future__ import annotations

from typing import Any

from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import INK, MEASURED, MODEL, TOOLBAR_PX, axis, filled, hover_band, line, role
from stimrig.api.charts.model_charts import LARGE, segment_marks
from stimrig.api.models.stored_model import muscles_of

DASHES = ("solid", "dash", "dot", "dashdot")
"""Beside the colour: for a grey print."""


def colour_of(number: int) -> str:
    """Of the channel with this number, from 1."""
    return role(f"muscle-{number}" if number <= 2 else f"series-{number - 2}")


def _look(number: int, width: float = 1.8) -> tuple[str, float, dict[str, Any]]:
    return colour_of(number), width, {"line": {"dash": DASHES[(number - 1) % len(DASHES)]}}


def muscle_figures(document: dict[str, Any], curves: dict[str, Any] | None) -> dict[str, Any]:
    """All of them; those that need the measurement only if there is one."""
    owners = muscles_of(document)
    figures = {"recruitment": recruitment(owners)}
    if curves is not None:
        own = curves["muscles"]
        figures["overview"] = measurement(curves, whole=False)
        figures[LARGE] = measurement(curves)
        figures["step"] = step(owners, {name: one["step_response"] for name, one in own.items()})
    return figures


def recruitment(owners: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Each muscle's curve with its band."""
    data = []
    for number, (name, own) in enumerate(owners.items(), start=1):
        curve, known, (colour, width, dash) = own["recruitment"], fig.band_of(own, "recruitment"), _look(number, 2.2)
        data += _band(known, "pulse_width_us", name, number)
        said = hover_band(name, fig.TORQUE, curve["pulse_width_us"], known, "pulse_width_us")
        data.append(line(curve["pulse_width_us"], curve["torque_nm"], name, colour, width, **dash, **said))
    x, y = axis("Pulse width (µs)", **fig.AT_WIDTH), axis("Steady torque (N·m)")
    return fig.figure(data, height=340, xaxis=x, yaxis=y)


def step(owners: dict[str, dict[str, Any]], responses: dict[str, dict[str, list[float]]]) -> dict[str, Any]:
    """Each muscle's step response with its band."""
    data, last_s = [], 0.0
    for number, (name, own) in enumerate(owners.items(), start=1):
        known, found, (colour, width, dash) = fig.band_of(own, "step_response"), responses[name], _look(number, 2.2)
        data += _band(known, "time_s", name, number)
        said = hover_band(name, fig.SHARE, found["time_s"], known, "time_s")
        data.append(line(found["time_s"], found["response"], name, colour, width, **dash, **said))
        last_s = max(last_s, found["time_s"][-1])
    x, y = axis("Time (s)", range=[0, last_s], **fig.AT_TIME), axis("Share of the final torque (1)")
    return fig.figure(data, height=340, xaxis=x, yaxis=y)


def _band(known: dict[str, Any], along: str, name: str, number: int) -> list[dict[str, Any]]:
    if not known:
        return []
    fill = role(f"muscle-{number}-band" if number <= 2 else "series-band")
    words = f"95 % band of {name}"
    return filled(known[along], known["whole_lower"], known["whole_upper"], words, fill)


def measurement(curves: dict[str, Any], whole: bool = True) -> dict[str, Any]:
    """Torque measured and predicted, below it what each muscle gives to it; with `whole` what is left, and the pulses.

    The muscles' torques are without the torque at rest.
    """
    time_s, measured_nm, predicted_nm = curves["time_s"], curves["torque_nm"], curves["predicted_torque_nm"]
    shapes, labels = segment_marks(curves["segments"])
    said = fig.hover("measured", fig.TORQUE + fig.BESIDE, fig.name_segments(time_s, curves["segments"]))
    data = [
        line(time_s, measured_nm, "measured", MEASURED, 3.2, **said),
        line(time_s, predicted_nm, "model, free run", MODEL, 1.8, **fig.hover("model", fig.TORQUE)),
    ]
    stairs = {"yaxis": "y4", "showlegend": False}
    for number, (name, own) in enumerate(curves["muscles"].items(), start=1):
        colour, width, dash = _look(number)
        data.append(
            line(time_s, own["torque_nm"], name, colour, width, yaxis="y2", **dash, **fig.hover(name, fig.TORQUE))
        )
        if whole:
            said = fig.hover(name, fig.WIDTH)
            data.append(line(time_s, own["pulse_width_us"], name, colour, 1.2, line={"shape": "hv"}, **stairs, **said))
    torque, share = "Torque (N·m)", "Each muscle (N·m)"
    if not whole:
        axes = {"yaxis": axis(torque, domain=[0.48, 1.0], nticks=5), "yaxis2": axis(share, domain=[0, 0.4], nticks=4)}
        below, height, margin = "y2", 300, {"l": 52, "r": TOOLBAR_PX, "t": 6, "b": 34}
    else:
        left = [round(m - p, 5) for m, p in zip(measured_nm, predicted_nm, strict=True)]
        words = "measured − model"
        said = fig.hover(words, fig.RESIDUAL)
        data.append(line(time_s, left, words, INK, 1.0, yaxis="y3", showlegend=False, **said))
        axes = {
            "yaxis": axis(torque, domain=[0.66, 1.0]), "yaxis2": axis(share, domain=[0.4, 0.6]),
            "yaxis3": axis("Residual (N·m)", domain=[0.22, 0.36]),
            "yaxis4": axis("Pulse width (µs)", domain=[0.0, 0.17], rangemode="tozero"),
        }  # fmt: skip
        below, height, margin = "y4", 800, {"l": 64, "r": TOOLBAR_PX, "t": 60, "b": 48}
    x = axis("Time (s)", anchor=below, range=[time_s[0], time_s[-1]], **fig.AT_TIME)
    more = {"shapes": shapes, "annotations": labels, "hoversubplots": "axis", "xaxis": x, **axes}
    return fig.figure(data, height=height, margin=margin, **more)

"""A model's figures and a recording's, as plain plotly objects: the same for the page and for reports."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import INK, MEASURED, MODEL, STIMULUS, TOOLBAR_PX, axis, band, band_of, box, line, role
from stimrig.identify.records.record import HELD_OUT

SHOWN_BEYOND = 1.5
"""Of the plan that was not played so much is drawn, in parts of what was."""
PAUSE, PAUSE_S = 20.0, 2.0
"""A pause lasts more than so many of the usual steps in time, and more than so many seconds: no line crosses it."""
LETTER = 0.007
"""Width of a letter of a segment's name, as a share of a wide chart."""
SYMBOLS = {"rising": "triangle-up", "falling": "triangle-down"}
LARGE = "comparison"
"""The figure with all lines."""


def model_figures(
    document: dict[str, Any], curves: dict[str, Any] | None, comparison: dict[str, Any] | None = None
) -> dict[str, Any]:
    """All figures of a model's page; those that need the measurement only if there is one."""
    figures = {"recruitment": recruitment(document, curves)}
    if curves is not None:
        noise_sd_nm = (document.get("fit") or {}).get("noise_sd_nm")
        figures[LARGE] = measurement(curves, noise_sd_nm, (comparison or {}).get("series"))
        figures["step"] = step(document, curves["step_response"])
    return figures


# ---- torque, residual and pulse width over time -------------------------------------------------------------------


def measurement(
    curves: dict[str, Any], noise_sd_nm: float | None, series: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Torque measured and predicted with its band, what is left, and the pulse width, on one time axis."""
    time_s = curves["time_s"]
    shapes, labels = segment_marks(curves["segments"])
    if noise_sd_nm:
        shapes.append(box(time_s[0], time_s[-1], fig.NOISE, -2 * noise_sd_nm, 2 * noise_sd_nm, yref="y2"))
    return fig.figure(
        measured_lines(curves, series),
        height=720,
        shapes=shapes,
        annotations=labels,
        hoversubplots="axis",
        legend={"orientation": "h", "x": 0, "y": 1.04, "yanchor": "bottom", "traceorder": "normal"},
        margin={"l": 64, "r": TOOLBAR_PX, "t": 60, "b": 48},
        xaxis=axis("Time (s)", anchor="y3", range=[time_s[0], time_s[-1]], **fig.AT_TIME),
        yaxis=axis("Torque (N·m)", domain=[0.52, 1.0]),
        yaxis2=axis("Residual (N·m)", domain=[0.27, 0.46]),
        yaxis3=axis("Pulse width (µs)", domain=[0.0, 0.2], rangemode="tozero"),
    )


def overview(large: dict[str, Any]) -> dict[str, Any]:
    """Torque and residual of the large chart, low enough for the first screen.

    The pulse width is said under the pointer, and not drawn.
    """
    layout = {name: value for name, value in large["layout"].items() if name not in ("yaxis", "yaxis2")}
    labels = [{**label, "yanchor": "middle", "y": 0.36, "font": {**label["font"], "size": 11}}
              for label in layout["annotations"]]  # fmt: skip
    layout |= {
        "height": 260,
        "annotations": labels,
        "legend": {**layout["legend"], "y": 1.01, "font": {"size": 11}},
        "margin": {"l": 52, "r": TOOLBAR_PX, "t": 6, "b": 34},
        "xaxis": {**layout["xaxis"], "anchor": "y2"},
        "yaxis": axis("Torque (N·m)", domain=[0.43, 1.0], nticks=5),
        "yaxis2": axis("Residual (N·m)", domain=[0.0, 0.29], nticks=4),
        "yaxis3": {"visible": False, "domain": [0.0, 0.29], "overlaying": "y2"},
    }
    only_said = [{**line, "line": {**line["line"], "width": 0}} if line.get("yaxis") == "y3" else line
                 for line in large["data"]]  # fmt: skip
    return {"data": only_said, "layout": layout}


def measured_lines(curves: dict[str, Any], series: dict[str, Any] | None) -> list[dict[str, Any]]:
    """The traces of the measurement: torque on y, residual on y2, pulse width on y3, all over the same x."""
    curves = broken_at_pauses(curves)
    time_s, torque_nm, predicted_nm = curves["time_s"], curves["torque_nm"], curves["predicted_torque_nm"]
    residual = [
        None if predicted is None or measured is None else round(measured - predicted, 5)
        for measured, predicted in zip(torque_nm, predicted_nm, strict=True)
    ]
    names = fig.name_segments(time_s, curves["segments"])
    data = [
        line(time_s, torque_nm, "measured", MEASURED, 3.2,
             **fig.hover("measured", fig.TORQUE + fig.BESIDE, names)),
        line(time_s, predicted_nm, "model, free run", MODEL, 1.8, **fig.hover("model", fig.TORQUE)),
        line(time_s, residual, "measured − model", INK, 1.0, yaxis="y2", showlegend=False,
             **fig.hover("measured − model", fig.RESIDUAL)),
        line(time_s, curves["pulse_width_us"], "pulse width", STIMULUS, 1.2, yaxis="y3", showlegend=False,
             line={"shape": "hv"}, **fig.hover("pulse width", fig.WIDTH)),
    ]  # fmt: skip
    if series and series.get("lower_nm"):
        data[1:1] = fig.filled(series["time_s"], series["lower_nm"], series["upper_nm"], "95 % band of the model")
    return data


def broken_at_pauses(curves: dict[str, Any]) -> dict[str, Any]:
    """The curves with a point without a value in each pause between the recordings of a joined one."""
    time_s = curves["time_s"]
    steps_s = [after - before for before, after in pairwise(time_s)]
    usual_s = sorted(steps_s)[len(steps_s) // 2] if steps_s else 0.0
    pauses = [place + 1 for place, step_s in enumerate(steps_s) if step_s > max(PAUSE * usual_s, PAUSE_S)]
    if not pauses:
        return curves
    lines = [name for name in ("torque_nm", "predicted_torque_nm", "pulse_width_us") if name in curves]
    broken: dict[str, list[Any]] = {name: list(curves[name]) for name in ("time_s", *lines)}
    for place in reversed(pauses):
        broken["time_s"].insert(place, (time_s[place - 1] + time_s[place]) / 2)
        for name in lines:
            broken[name].insert(place, None)
    return {**curves, **broken}


def segment_marks(segments: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Shades of the segments, and their names where they have room; the held-out one stands out."""
    shapes, labels, free_s = [], [], -math.inf
    letter_s = LETTER * (segments[-1]["end_s"] if segments else 0.0)
    for segment in segments:
        name, start_s, end_s = segment["name"], segment["start_s"], segment["end_s"]
        if name == "rest":
            continue
        shapes.append(box(start_s, end_s, role("held-out" if name == HELD_OUT else "segment")))
        text, middle_s = fig.segment_name(name), (start_s + end_s) / 2
        half_s = letter_s * len(text) / 2
        if middle_s - half_s < free_s:
            continue  # it would be written over the name before it
        free_s = middle_s + half_s
        labels.append({"xref": "x", "yref": "paper", "x": middle_s, "y": 1.0, "yanchor": "bottom",
                       "text": text, "showarrow": False,
                       "font": {"size": 12, "color": role("mark")}})  # fmt: skip
    return shapes, labels


def recorded(found: dict[str, Any], plan_us: list[float], rate_hz: float, how: str) -> dict[str, Any]:
    """A test without a model: what was measured and sent until its end, and what was planned beyond it, faint."""
    end_s = found["pulses_end_s"]
    last_s = max([end_s, *found["time_s"][-1:]])
    stairs: dict[str, Any] = {"yaxis": "y2", "line": {"shape": "hv"}}
    data = [
        line(found["time_s"], found["torque_nm"], "torque, measured", MODEL, 1.8),
        line(found["pulse_time_s"], found["sent_pulse_width_us"], "pulse width, sent", STIMULUS, 1.8, **stairs),
    ]
    rest = [(k / rate_hz, width_us) for k, width_us in enumerate(plan_us) if k / rate_hz >= end_s - 0.5 / rate_hz]
    shapes, labels = segment_marks(found["segments"])
    if rest:
        last_s = max(last_s, min(rest[-1][0] + 1.0 / rate_hz, SHOWN_BEYOND * end_s + 2.0))
        beyond_s, planned_us = zip(*[at for at in rest if at[0] <= last_s], strict=True)
        data.append(line(list(beyond_s), list(planned_us), "planned, not played", fig.FAINT, 1.2, **stairs))
        shapes.append({"type": "line", "xref": "x", "yref": "paper", "x0": end_s, "x1": end_s, "y0": 0, "y1": 1,
                       "line": {"color": INK}})  # fmt: skip
        words = fig.unlinked(f"{how} at {end_s:.1f} s")
        labels.append({"xref": "x", "yref": "paper", "x": end_s, "y": 0.42, "text": words})
    axes = {"yaxis": axis("Torque (N·m)", domain=[0.48, 1.0])}
    axes["yaxis2"] = axis("Pulse width (µs)", domain=[0.0, 0.36], rangemode="tozero")
    if found.get("angle_deg"):
        data.append(line(found["angle_time_s"], found["angle_deg"], "angle of the joint", INK, 1.6, yaxis="y3"))
        axes["yaxis"]["domain"], axes["yaxis2"]["domain"] = [0.6, 1.0], [0.0, 0.2]
        axes["yaxis3"] = axis("Angle (°)", domain=[0.3, 0.5])
    return fig.figure(data, shapes=shapes, annotations=labels, xaxis=axis("Time (s)", range=[0.0, last_s]), **axes)


def inversion(found: dict[str, Any]) -> dict[str, Any]:
    """The figure of what `POST /v1/models/{id}/widths` answers; what is out of reach is shaded."""
    time_s = [round(k / found["pulse_rate_hz"], 6) for k in range(len(found["pulse_width_us"]))]
    return fig.figure(
        [
            line(time_s, found["predicted_torque_nm"], "predicted", MODEL, 2.2),
            line(time_s, found["reference_torque_nm"], "Reference", INK, 1.4, line={"dash": "dash"}),
            line(time_s, found["pulse_width_us"], "pulse width", STIMULUS, 1.2, yaxis="y2", showlegend=False,
                 line={"shape": "hv"}),
        ],
        height=460,
        shapes=[box(one["begin_s"], one["end_s"], role("worst-band")) for one in found["unreachable"]],
        xaxis=axis("Time (s)", range=[0.0, found["duration_s"]]),
        yaxis=axis("Torque above rest (N·m)", domain=[0.42, 1.0]),
        yaxis2=axis("Pulse width (µs)", domain=[0.0, 0.32], rangemode="tozero"),
    )  # fmt: skip


# ---- the recruitment curve and the step response ------------------------------------------------------------------


def recruitment(document: dict[str, Any], curves: dict[str, Any] | None = None) -> dict[str, Any]:
    """The recruitment curve with its band; with a recording's curves, what its ramp says on the way up and down."""
    curve, known = document["recruitment"], band_of(document, "recruitment")
    width_us = curve["pulse_width_us"]
    said = fig.hover_band("model", fig.TORQUE, width_us, known, "pulse_width_us")
    data = [*band(known, "pulse_width_us"), line(width_us, curve["torque_nm"], "model", MODEL, 2.2, **said)]
    words = {"rising": "ramp up", "falling": "ramp down"}
    for way, points in sorted(ramp_points(document, curves).items(), reverse=True) if curves else []:
        marker = {"symbol": SYMBOLS[way], "size": 9, "color": role("chart"),
                  "line": {"color": role(way), "width": 1.8}}  # fmt: skip
        data.append(line(points["pulse_width_us"], points["torque_nm"], words[way], role(way), mode="markers",
                         marker=marker, **fig.hover(words[way], fig.TORQUE)))  # fmt: skip
    x, y = axis("Pulse width (µs)", **fig.AT_WIDTH), axis("Steady torque (N·m)")
    return fig.figure(data, height=340, xaxis=x, yaxis=y, showlegend=len(data) > 1)


def step(document: dict[str, Any], response: dict[str, list[float]]) -> dict[str, Any]:
    """The linear part's step response with its band."""
    known, time_s = band_of(document, "step_response"), response["time_s"]
    said = fig.hover_band("model", fig.SHARE, time_s, known, "time_s")
    data = [*band(known, "time_s"), line(time_s, response["response"], "model", MODEL, 2.2, **said)]
    x = axis("Time (s)", range=[0, time_s[-1]], **fig.AT_TIME)
    y = axis("Share of the final torque (1)")
    return fig.figure(data, height=340, xaxis=x, yaxis=y, showlegend=bool(known))


WINDOW_S = 0.6
"""A slope is taken over this long; a pulse width that jumps or turns within it has no direction."""
FASTEST_US_PER_S = 200.0
BINS = 16
LEAST_SAMPLES = 3


def ramp_points(document: dict[str, Any], curves: dict[str, Any]) -> dict[str, dict[str, list[float]]]:
    """What a slow ramp says of the recruitment curve on its way up and on its way down.

    A partial residual plot: the curve's own value plus what the measurement has more than the free run, at the pulse
    width in force one mean lag of the linear part earlier. Where both directions lie on the curve, one is enough.

    ``rising`` and ``falling``: ``pulse_width_us``, µs, and ``torque_nm``, N·m; absent where the recording has none.
    """
    time_s, width_us = curves["time_s"], curves["pulse_width_us"]
    if len(time_s) < 3:
        return {}
    step_s = (time_s[-1] - time_s[0]) / (len(time_s) - 1)
    lag = round(mean_lag_s(document["linear"]) / step_s)
    half = max(1, round(WINDOW_S / 2 / step_s))
    top_us = max(width_us)
    sums: dict[tuple[str, int], list[float]] = {}
    for index in range(lag + half, len(time_s) - half):
        at = index - lag
        way = direction(width_us[max(0, at - half) : at + half + 1], 2 * half * step_s, top_us)
        predicted = curves["predicted_torque_nm"][index]
        if way and predicted is not None:
            bin_ = min(BINS - 1, int(BINS * width_us[at] / top_us))
            found = sums.setdefault((way, bin_), [0.0, 0.0, 0.0])
            for place, value in enumerate((1.0, width_us[at], curves["torque_nm"][index] - predicted)):
                found[place] += value
    return _bin_means(sums, document["recruitment"])


def direction(widths_us: Sequence[float], span_s: float, top_us: float) -> str | None:
    """rising, falling, or None where the width stands, jumps or turns."""
    change = widths_us[-1] - widths_us[0]
    if not 0.02 * top_us < abs(change) < FASTEST_US_PER_S * span_s:
        return None
    steps = [after - before for before, after in pairwise(widths_us)]
    if max(steps) >= 0.5 * abs(change) or min(steps) <= -0.5 * abs(change) or (max(steps) > 0 > min(steps)):
        return None
    return "rising" if change > 0 else "falling"


def mean_lag_s(linear: dict[str, Any]) -> float:
    """How far the torque of a ramp trails: 2 ζ T + delay for the second order, 0 where it is not known."""
    time_s, damping = linear.get("time_constant_s"), linear.get("damping")
    if time_s is None or damping is None:
        return 0.0
    return max(0.0, 2.0 * damping * time_s + (linear.get("delay_s") or 0.0))


def _bin_means(sums: dict[tuple[str, int], list[float]], curve: dict[str, Any]) -> dict[str, dict[str, list[float]]]:
    found: dict[str, dict[str, list[float]]] = {}
    for (way, _bin), (count, width, more) in sorted(sums.items()):
        if count < LEAST_SAMPLES:
            continue
        points = found.setdefault(way, {"pulse_width_us": [], "torque_nm": []})
        points["pulse_width_us"].append(round(width / count, 2))
        on_curve = fig.interpolate(width / count, curve["pulse_width_us"], curve["torque_nm"])
        points["torque_nm"].append(round(on_curve + more / count, 4))
    return found


# ---- several models -----------------------------------------------------------------------------------------------

COLOURS = tuple(role(f"series-{number}") for number in range(1, 7))
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
MOST = len(COLOURS)
BANDED = 3
"""With more models than this their bands would hide one another."""


def style(number: int) -> dict[str, str]:
    """Colour and dash of the n-th model: either of them alone tells it from the others."""
    return {"colour": COLOURS[number], "dash": DASHES[number]}


def compared_recruitment(documents: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, Any]:
    """All recruitment curves; with their bands where they are few."""
    data: list[dict[str, Any]] = []
    for number, (document, name) in enumerate(zip(documents, names, strict=True)):
        if len(documents) <= BANDED and (pair := band(band_of(document, "recruitment"), "pulse_width_us")):
            pair[1] |= {"fillcolor": role("series-band"), "name": "", "showlegend": False}
            data += pair
        curve = document["recruitment"]
        data.append(_series(curve["pulse_width_us"], curve["torque_nm"], name, number, fig.TORQUE))
    x, y = axis("Pulse width (µs)", **fig.AT_WIDTH), axis("Steady torque (N·m)")
    return fig.figure(data, height=380, xaxis=x, yaxis=y)


def compared_step(curves: Sequence[dict[str, Any] | None], names: Sequence[str]) -> dict[str, Any]:
    """All step responses."""
    data = [
        _series(found["step_response"]["time_s"], found["step_response"]["response"], name, number, fig.SHARE)
        for number, (found, name) in enumerate(zip(curves, names, strict=True))
        if found
    ]
    x, y = axis("Time (s)", **fig.AT_TIME), axis("Share of the final torque (1)")
    return fig.figure(data, height=380, xaxis=x, yaxis=y)


def _series(x: Sequence[float], y: Sequence[float], name: str, number: int, value: str) -> dict[str, Any]:
    return line(x, y, name, COLOURS[number], 2.2, line={"dash": DASHES[number]}, **fig.hover(name, value))

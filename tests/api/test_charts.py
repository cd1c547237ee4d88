"""Charts: their data (values, bands, units), how they are drawn, and the CSV of a recording."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import httpx
import numpy as np
import pytest

from stimrig import identify
from stimrig.api.charts import diagnosis_charts, drawing, joint_charts, model_charts
from stimrig.api.charts import figure as fig
from stimrig.api.charts.drawing import Figures, decimate, svg
from stimrig.api.charts.figure import LIGHT, Axis, Band, Curve, Figure, Label
from stimrig.api.charts.interactive import plotly_figure
from stimrig.api.jobs.curves import curves
from stimrig.api.sessions import joint_plan
from tests.api import made_up_joint
from tests.api.conftest import Service, play_test, shared_service
from tests.api.fake_rig import default_widths, muscle


@cache
def measured(after: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """A made-up muscle's record, and the model fitted to it; `after` bends the torque."""
    widths, segments = default_widths()
    torque = np.array(muscle(widths, 400.0)).reshape(-1, 5).mean(axis=1)
    time_s = np.arange(torque.size) / 80
    width = np.repeat(widths, 2)
    name = np.full(torque.size, "rest", dtype="U16")
    for segment in segments:
        name[(time_s >= segment["start_s"]) & (time_s < segment["end_s"])] = segment["name"]
    if after is not None:
        torque = torque + after(width)
    record = identify.Record.from_arrays(time_s, width, torque, name)
    model = identify.fit(record)
    return model.to_dict(), curves(model, record)


def distance(found: dict[str, Any]) -> float:
    """Mean of falling minus rising at the widths that both have, N·m."""
    up, down = found["rising"], found["falling"]
    at = np.linspace(80, 250, 30)
    falling = np.interp(at, down["pulse_width_us"], down["torque_nm"])
    return float(np.mean(falling - np.interp(at, up["pulse_width_us"], up["torque_nm"])))


# ---- data ------------------------------------------------------------------------------------------------------------


def test_both_directions_of_the_ramp_lie_on_the_curve_of_a_muscle_without_hysteresis() -> None:
    document, drawn = measured()
    found = model_charts.ramp_points(document, drawn)
    known = document["recruitment"]
    assert set(found) == {"rising", "falling"}
    for points in found.values():
        curve = np.interp(points["pulse_width_us"], known["pulse_width_us"], known["torque_nm"])
        assert np.abs(np.array(points["torque_nm"]) - curve).max() < 0.12
    assert abs(distance(found)) < 0.06


def test_a_muscle_with_hysteresis_shows_two_curves() -> None:
    def lag(width: Any) -> Any:
        falls = np.zeros(width.size)
        slope = np.diff(width, prepend=width[0])
        falls[(slope < 0) | (np.roll(slope, 1) < 0)] = 1.0
        ramp = (slope != 0) | (np.roll(slope, 1) != 0)
        return np.where(ramp & (falls > 0), 0.8, 0.0)

    document, drawn = measured(lag)
    found = model_charts.ramp_points(document, drawn)
    assert distance(found) > 0.2, "less than the 0.8 N·m put in: the fitted lag takes a part of it upon itself"
    figure = model_charts.recruitment(document, drawn)
    assert {"ramp up", "ramp down"} <= {curve.label for curve in figure.curves}


def test_a_recording_without_a_ramp_has_no_directions() -> None:
    document, drawn = measured()
    still = {**drawn, "pulse_width_us": [0.0, 200.0] * (len(drawn["time_s"]) // 2)}
    assert model_charts.ramp_points(document, still) == {}
    short = {name: drawn[name][:1] for name in ("time_s", "pulse_width_us", "torque_nm", "predicted_torque_nm")}
    assert model_charts.ramp_points(document, short) == {}


NAMES = ("recruitment", "comparison", "overview", "step", "residual", "signature", "falling", "joint_g", "joint_h")


@cache
def figures() -> dict[str, Figure]:
    """All figures of a made-up muscle's model page."""
    document, drawn = measured()
    rows = [{"label": label, "rms_nm": rms, "held_out_rms_nm": rms, "noise_sd_nm": 0.04, "current": False}
            for label, rms in (("base", 0.12), ("+ fatigue", 0.05))]  # fmt: skip
    effect = {"seen_nm": [0.1, 0.2], "expected_nm": [0.1, 0.1]}
    series = {"time_s": [0.0, 1.0], "residual_nm": [0.01, 0.02], "noise_band_nm": 0.08}
    segments = [{"name": "prbs", "start_s": 0.0, "end_s": 1.0}]
    return {
        **model_charts.model_figures(document, drawn),
        "residual": diagnosis_charts.residual({"series": series}, segments, []),
        "signature": diagnosis_charts.signature([0.0, 1.0], effect),
        "falling": diagnosis_charts.falling(rows),
        **joint_charts.joint_figures({"joint": made_up_joint.joint()}),
    }


def test_the_measurement_is_torque_residual_and_pulse_width_on_one_axis() -> None:
    document, drawn = measured()
    large, overview = figures()["comparison"], figures()["overview"]
    torque, predicted, left, width = large.curves
    assert torque.y == drawn["torque_nm"] and predicted.y == drawn["predicted_torque_nm"]
    numbers = [np.array(curve.y, dtype=float) for curve in (torque, predicted, left)]
    assert np.allclose(numbers[0] - numbers[1], numbers[2], atol=1e-5) and width.y == drawn["pulse_width_us"]
    assert [curve.panel for curve in large.curves] == [0, 0, 1, 2] and width.step
    noise = next(shade for shade in large.shades if shade.low is not None)
    assert noise.panel == 1 and noise.high == pytest.approx(2 * document["fit"]["noise_sd_nm"])
    assert overview.curves == large.curves[:3] and overview.height <= 260
    assert [label.text for label in large.labels][-1].startswith("Check")


def test_no_line_goes_through_the_pause_between_two_recordings() -> None:
    _document, drawn = measured()
    assert model_charts.broken_at_pauses(drawn) is drawn, "one recording has no pause"
    half = len(drawn["time_s"]) // 2
    first, second = drawn["time_s"][:half], drawn["time_s"][half:]
    slow = {**drawn, "time_s": [*first, *(second[0] + place for place in range(len(second)))]}
    assert model_charts.broken_at_pauses(slow) is slow, "slower sampling is no pause"
    paused = {**drawn, "time_s": [*first, *(moment_s + 600.0 for moment_s in second)]}
    figure = model_charts.measurement(paused, None)
    for curve in figure.curves:
        assert len(curve.x) == len(curve.y) == len(drawn["time_s"]) + 1 and curve.y[half] is None
        assert curve.x[half] == pytest.approx((paused["time_s"][half - 1] + paused["time_s"][half]) / 2)
        assert len(curve.notes) in (0, len(curve.x))
    assert "nan" not in svg(figure).lower()


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_and_every_value_has_its_unit_and_every_colour_its_role(name: str) -> None:
    figure = figures()[name]
    axes = [figure.x, *figure.panels]
    assert all(re.search(r" \(.+\)$", axis.label) or axis.ticks for axis in axes), [axis.label for axis in axes]
    for curve in figure.curves:
        unit = {"joint_g": "", "step": ""}.get(name, "µs" if curve.label == "pulse width" else "N·m")
        assert curve.value is None or curve.value.unit.strip() == unit
        assert len(curve.x) == len(curve.y) and curve.colour in LIGHT
    assert {part.colour for part in (*figure.bands, *figure.shades, *figure.rules)} <= set(LIGHT)


def test_the_error_falls_to_the_noise() -> None:
    figure = figures()["falling"]
    fitted, _current, held_out, _ = figure.curves
    assert (fitted.y, held_out.y) == ([0.12, 0.05], [0.12, 0.05]) and figure.rules[0].at == 0.04
    assert [words for _at, words in figure.x.ticks] == ["1. base", "2. + fatigue"]


def test_the_band_of_a_curve_is_that_of_the_document() -> None:
    document, _drawn = measured()
    known = document["uncertainty"]["bands"]["recruitment"]
    (band,) = figures()["recruitment"].bands
    assert (band.x, band.lower, band.upper) == tuple(known[key] for key in
                                                     ("pulse_width_us", "whole_lower", "whole_upper"))  # fmt: skip
    assert fig.half_widths(Band([0.0, 10.0], [1.0, 2.0], [1.2, 2.6]), [0.0, 5.0, 12.0]) == [
        "± 0.10",
        "± 0.20",
        "± 0.30",
    ]
    assert fig.half_widths(None, [0.0]) == []


def test_each_time_has_the_segment_it_lies_in() -> None:
    segments = [{"name": name, "start_s": start} for name, start in (("a", 0.0), ("b", 1.0), ("c", 2.0))]
    assert fig.segment_names([0.0, 0.9, 1.0, 2.0, 9.0], segments) == ["· a", "· a", "· b", "· c", "· c"]
    assert fig.segment_names([0.0], []) == [""]


# ---- g and h: the document's own numbers, bands where the joint was seen, dotted where it was not

JOINT = made_up_joint.joint()
ANGLES_DEG = [20 + 1.5 * k for k in range(61)]
SPEEDS = {"not moving": 0.0, "bending 23°/s": 0.4, "bending 46°/s": 0.8,
          "straightening 23°/s": -0.4, "straightening 46°/s": -0.8}  # fmt: skip
"""What the legend says, and the velocity it stands for, rad/s: of each way the one that was seen most."""
NEAR_DEG = 3.0


def was_seen(name: str, angle_deg: float, velocity_rad_s: float) -> bool:
    """By the arm's own law, near an angle and anywhere in the way of moving."""
    law = getattr(made_up_joint, f"seen_{name}")
    near = [angle for angle in made_up_joint.ANGLES_RAD if abs(math.degrees(angle) - angle_deg) <= NEAR_DEG + 1e-6]
    return any(law(angle, velocity_rad_s) for angle in near)


@pytest.mark.parametrize("name", ["g", "h"])
def test_lines_and_bands_are_the_documents_where_the_joint_was_seen_and_dotted_elsewhere(name: str) -> None:
    law, figure = made_up_joint.g if name == "g" else made_up_joint.h_nm, figures()[f"joint_{name}"]
    lines = {curve.label: curve for curve in figure.curves if curve.value}
    assert set(lines) == set(SPEEDS) - ({"straightening 46°/s"} if name == "g" else set()), "never seen is left out"
    for words, curve in lines.items():
        assert curve.x == pytest.approx(ANGLES_DEG) and any(value is not None for value in curve.y)
        for angle_deg, value in zip(ANGLES_DEG, curve.y, strict=True):
            assert (value is not None) == was_seen(name, angle_deg, SPEEDS[words]), (words, angle_deg)
            assert value is None or value == pytest.approx(law(math.radians(angle_deg), SPEEDS[words]))
    count = 0
    for band in figure.bands:
        for angle_deg, low, high in zip(band.x, band.lower, band.upper, strict=True):
            assert high - low == pytest.approx(2 * made_up_joint.half(math.radians(angle_deg)))
            row = round((angle_deg - ANGLES_DEG[0]) / 1.5)
            assert any(curve.y[row] == pytest.approx((low + high) / 2) for curve in lines.values())
            count += 1
    assert count == sum(value is not None for curve in lines.values() for value in curve.y)
    dotted = [curve for curve in figure.curves if curve.dash == "dot"]
    assert len(dotted) == sum(None in curve.y for curve in lines.values()) > 0
    assert [entry.label for entry in figure.entries()] == ["95 % band", "dotted: not seen", *lines], "each once"


def test_all_seen_needs_no_dots_and_no_band_none_of_it() -> None:
    bare = {key: value for key, value in JOINT.items() if "lower" not in key and "upper" not in key}
    ones = [[1] * len(row) for row in JOINT["seen_g"]]
    for figure in joint_charts.joint_figures({"joint": {**bare, "seen_g": ones, "seen_h": ones}}).values():
        assert len(figure.curves) == 5 and not figure.bands
        assert all(curve.dash == "solid" and not curve.notes for curve in figure.curves)
    for document in ({}, {"joint": {}}, {"joint": {"g": [[1.0]]}}):
        assert joint_charts.joint_figures(document) == {}
    assert (joint_charts.STILL_RAD_S, joint_charts.FAST_RAD_S) == (joint_plan.SLOW_RAD_S, joint_plan.FAST_RAD_S)


# ---- drawn -----------------------------------------------------------------------------------------------------------

LINE = Figure(
    Axis("Time (s)"), (Axis("Torque (N·m)"), Axis("Width (µs)")),
    (Curve([0.0, 10.0, 20.0], [0.0, 1.0, None], "<a> & $b$", "model"),
     Curve([0.0, 10.0], [1.0, 2.0], "b", "width", panel=1)),
    labels=(Label(5.0, "<i>&"), Label(6.0, "1", "worst")),
)  # fmt: skip


def words_of(picture: str) -> set[str | None]:
    return {text.text for text in ElementTree.fromstring(picture).iter("{http://www.w3.org/2000/svg}text")}


@pytest.mark.parametrize("name", NAMES)
def test_a_still_is_whole_svg_with_its_axes_in_colours_of_the_page(name: str) -> None:
    picture = str(svg(figures()[name], 760.0, label="<x> & more"))
    root = ElementTree.fromstring(picture)
    assert root.attrib["aria-label"] == "<x> & more" and root.attrib["viewBox"].startswith("0 0 760 ")
    words = " ".join(filter(None, words_of(picture)))
    assert all(
        part in words for axis in (figures()[name].x, *figures()[name].panels) for part in axis.label.split(" (")
    )
    assert "style=" not in picture and " id=" not in re.sub(r"<(clipPath|path) id=", "", picture)
    assert not re.search(r"#[0-9a-f]{6}\b", picture) and "var(--" in picture, "a colour would stay light in the dark"
    assert "var(--" not in svg(figures()[name], 760.0, light=True)


def test_words_of_a_recording_are_words() -> None:
    words = words_of(str(svg(LINE)))
    assert {"<i>&", "<a> & $b$", "1"} <= words
    assert "<i>&" not in words_of(str(svg(LINE, 300.0))), "a narrow chart has no room for names"
    data = plotly_figure(LINE)
    assert data["data"][0]["name"] == "‹a› & $b$" and data["layout"]["annotations"][0]["text"] == "‹i›&"


def test_files_open_and_hold_their_caption() -> None:
    drawn = Figures({"line": LINE}, captions={"line": "A caption"})
    assert b'aria-label="A caption"' in drawn.file("line", "svg")
    assert drawn.file("line", "png").startswith(b"\x89PNG")
    plain = Figures({"line": LINE}).file("line", "pdf")
    assert plain.startswith(b"%PDF") and len(drawn.file("line", "pdf")) > len(plain)


def test_a_still_is_as_small_as_what_a_screen_shows_and_loses_no_peak() -> None:
    y = [math.sin(0.9 * k) for k in range(20_000)]
    y[7_777] = 5.0
    at, value = decimate(range(20_000), y)
    assert len(at) <= 2000 and 5.0 in value and at[list(value).index(5.0)] == 7_777
    at, value = decimate(range(20_000), [None if k == 500 else 1.0 for k in range(20_000)])
    assert list(at[np.isnan(value)]) == [500.0], "a gap stays"
    assert len(svg(figures()["overview"], 760.0)) < 45_000, "it stands in the page"
    curve = Curve(list(range(20_000)), y, "a", "model")
    assert len(svg(replace(LINE, curves=(curve,), labels=()), 300.0)) < 20_000


def test_a_picture_is_drawn_once_and_few_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "_cache", {})
    monkeypatch.setattr(drawing, "CACHE_SIZE", 2)
    drawn: list[float] = []
    monkeypatch.setattr(drawing, "_draw", lambda _kind, _figure, width, *_: (drawn.append(width), b">")[1])
    for width in (300.0, 300.0, 400.0, 500.0, 500.0, 300.0):
        svg(LINE, width)
    assert drawn == [300.0, 400.0, 500.0, 300.0] and len(drawing._cache) == 2


def test_plotly_gets_values_units_and_bands() -> None:
    made = plotly_figure(figures()["recruitment"], LIGHT.__getitem__)
    upper, lower, model, *ramps = made["data"]
    assert (upper["line"]["width"], lower["fill"]) == (0, "tonexty")
    assert model["hovertemplate"] == "model %{y:.2f} N·m %{customdata}<extra></extra>"
    assert model["customdata"][0].startswith("± ") and len(ramps) == 2
    assert made["layout"]["xaxis"]["title"]["text"] == "Pulse width (µs)" and "var(" not in str(made["layout"])
    large = plotly_figure(figures()["comparison"])["layout"]
    domains = [large[name]["domain"] for name in ("yaxis", "yaxis2", "yaxis3")]
    assert domains[0][1] == 1.0 and domains[2][0] >= 0.0
    assert all(above[0] > below[1] for above, below in pairwise(domains))


# ---- pages -----------------------------------------------------------------------------------------------------------


service = shared_service()


@pytest.fixture(scope="module")
def models(service: Service) -> tuple[str, str]:
    """Of a joint at rest, and with g and h."""
    with service.client() as http:
        test = play_test(http, "J1")
        both = http.post("/v1/participants/J1/models", json={"recordings": [test["recording_id"]]})
        assert both.status_code == 201, both.text
        return test["model_id"], both.json()["id"]


def test_reports_have_the_joint_and_pages_of_other_models_do_not(client: httpx.Client, models: tuple[str, str]) -> None:
    at_rest, moving = models
    for path, count in ((f"/models/{moving}", 2), (f"/models/{at_rest}", 0)):
        page = client.get(path).text
        assert page.count('data-figure="joint_') == count and ("joint_g.json" in page) == bool(count)
    assert client.get(f"/models/{moving}/report").text.count("<svg") == 5
    assert client.get(f"/models/{at_rest}/report").text.count("<svg") == 3

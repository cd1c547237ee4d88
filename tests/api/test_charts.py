"""Charts: their data (values, bands, units), and how they are drawn."""

from __future__ import annotations

import json
import math
import re
import xml.etree.ElementTree as ElementTree
from functools import cache
from itertools import pairwise
from typing import Any

import httpx
import numpy as np
import pytest

from stimrig import identify
from stimrig.api.charts import diagnosis_charts, joint_charts, model_charts
from stimrig.api.charts import figure as fig
from stimrig.api.charts.drawing import file, svg
from stimrig.api.charts.figure import LIGHT, axis, curve, figure
from stimrig.api.charts.plot import plot
from stimrig.api.jobs.curves import curves
from stimrig.api.sessions import joint_plan
from tests.api import made_up_joint
from tests.api.conftest import Service, play_test, shared_service
from tests.api.fake_rig import default_widths, muscle


@cache
def measured() -> tuple[dict[str, Any], dict[str, Any]]:
    """A made-up muscle's record, and the model fitted to it."""
    widths, segments = default_widths()
    torque = np.array(muscle(widths, 400.0)).reshape(-1, 5).mean(axis=1)
    time_s = np.arange(torque.size) / 80
    name = np.full(torque.size, "rest", dtype="U16")
    for segment in segments:
        name[(time_s >= segment["start_s"]) & (time_s < segment["end_s"])] = segment["name"]
    record = identify.Record.from_arrays(time_s, np.repeat(widths, 2), torque, name)
    model = identify.fit(record)
    return model.to_dict(), curves(model, record)


NAMES = ("recruitment", "comparison", "overview", "step", "residual", "signature", "falling", "joint_g", "joint_h")


@cache
def figures() -> dict[str, Any]:
    """All figures of a made-up muscle's model page."""
    document, drawn = measured()
    rows = [{"label": label, "rms_nm": rms, "held_out_rms_nm": rms, "noise_sd_nm": 0.04, "current": label != "base"}
            for label, rms in (("base", 0.12), ("+ fatigue", 0.05))]  # fmt: skip
    effect = {"seen_nm": [0.1, 0.2], "expected_nm": [0.1, 0.1]}
    series = {"time_s": [0.0, 1.0], "residual_nm": [0.01, 0.02], "noise_band_nm": 0.08}
    segments = [{"name": "prbs", "start_s": 0.0, "end_s": 1.0}]
    return {
        **model_charts.model_figures({**document, "joint": made_up_joint.joint()}, drawn),
        "residual": diagnosis_charts.residual({"series": series}, segments, []),
        "signature": diagnosis_charts.signature([0.0, 1.0], effect),
        "falling": diagnosis_charts.falling(rows),
    }


def axes(drawn: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {name: value for name, value in drawn["layout"].items() if re.match("[xy]axis", name)}


# ---- data ------------------------------------------------------------------------------------------------------------


def test_the_measurement_is_torque_residual_and_pulse_width_on_one_axis() -> None:
    document, drawn = measured()
    large, overview = figures()["comparison"], figures()["overview"]
    torque, predicted, left, width = large["data"]
    assert torque["y"] == drawn["torque_nm"] and predicted["y"] == drawn["predicted_torque_nm"]
    numbers = [np.array(trace["y"], dtype=float) for trace in (torque, predicted, left)]
    assert np.allclose(numbers[0] - numbers[1], numbers[2], atol=1e-5) and width["y"] == drawn["pulse_width_us"]
    assert [trace["yaxis"] for trace in large["data"]] == ["y", "y", "y2", "y3"] and width["line"]["shape"] == "hv"
    noise = next(shape for shape in large["layout"]["shapes"] if shape["xref"] == "paper")
    assert noise["yref"] == "y2" and noise["y1"] == pytest.approx(2 * document["fit"]["noise_sd_nm"])
    assert overview["data"] == large["data"][:3] and overview["layout"]["height"] <= 320
    assert large["layout"]["annotations"][-1]["text"].startswith("Check")
    domains = [axes(large)[name]["domain"] for name in ("yaxis", "yaxis2", "yaxis3")]
    assert domains[0][1] == 1.0 and domains[2][0] >= 0.0
    assert all(above[0] > below[1] for above, below in pairwise(domains))


def test_no_line_goes_through_the_pause_between_two_recordings() -> None:
    _document, drawn = measured()
    half = len(drawn["time_s"]) // 2
    first, second = drawn["time_s"][:half], drawn["time_s"][half:]
    slow = {**drawn, "time_s": [*first, *(second[0] + place for place in range(len(second)))]}
    assert model_charts.broken_at_pauses(slow) is slow, "slower sampling is no pause"
    paused = {**drawn, "time_s": [*first, *(moment_s + 600.0 for moment_s in second)]}
    broken = model_charts.measurement(paused, None)
    for trace in broken["data"]:
        assert len(trace["x"]) == len(trace["y"]) == len(drawn["time_s"]) + 1 and trace["y"][half] is None
        assert trace["x"][half] == pytest.approx((paused["time_s"][half - 1] + paused["time_s"][half]) / 2)
        assert len(trace.get("customdata", ())) in (0, len(trace["x"]))
    assert "nan" not in svg(broken).lower()


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_and_every_value_has_its_unit_and_every_colour_its_role(name: str) -> None:
    drawn = figures()[name]
    labels = [value["title"]["text"] for value in axes(drawn).values() if "ticktext" not in value]
    assert all(re.search(r" \(.+\)$", label) for label in labels), labels
    for trace in drawn["data"]:
        unit = {"joint_g": "", "step": ""}.get(name, "µs" if trace["name"] == "pulse width" else "N·m")
        end = f"}} {unit}".rstrip() + "<extra></extra>"
        assert trace.get("hovertemplate", end).replace(" %{customdata}", "").endswith(end)
        assert len(trace["x"]) == len(trace["y"])
    assert set(re.findall(r"var\(--([\w-]+)\)", json.dumps(drawn))) <= set(LIGHT)


def test_the_error_falls_to_the_noise() -> None:
    drawn = figures()["falling"]
    fitted, _current, held_out, _ = drawn["data"]
    assert (fitted["y"], held_out["y"]) == ([0.12, 0.05], [0.12, 0.05]) and drawn["layout"]["shapes"][0]["y0"] == 0.04
    assert drawn["layout"]["xaxis"]["ticktext"] == ["1. base", "2. + fatigue"]


def test_the_band_of_a_curve_is_that_of_the_document() -> None:
    document, _drawn = measured()
    known = document["uncertainty"]["bands"]["recruitment"]
    upper, lower, model = figures()["recruitment"]["data"]
    assert (lower["x"], lower["y"], upper["y"]) == tuple(known[key] for key in
                                                         ("pulse_width_us", "whole_lower", "whole_upper"))  # fmt: skip
    assert lower["fill"] == "tonexty" and upper["line"]["width"] == 0
    assert model["hovertemplate"] == "model %{y:.2f} N·m %{customdata}<extra></extra>"
    halves = fig.half_widths(fig.band([0.0, 10.0], [1.0, 2.0], [1.2, 2.6]), [0.0, 5.0, 12.0])
    assert halves == ["± 0.10", "± 0.20", "± 0.30"] and fig.half_widths([], [0.0]) == []


def test_each_time_has_the_segment_it_lies_in() -> None:
    segments = [{"name": name, "start_s": start} for name, start in (("a", 0.0), ("b", 1.0), ("c", 2.0))]
    assert fig.segment_names([0.0, 0.9, 1.0, 2.0, 9.0], segments) == ["· a", "· a", "· b", "· c", "· c"]
    assert fig.segment_names([0.0], []) == [""]


# ---- g and h: the document's own numbers, bands where the joint was seen, dotted where it was not

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
    law, traces = made_up_joint.g if name == "g" else made_up_joint.h_nm, figures()[f"joint_{name}"]["data"]
    lines = {trace["name"]: trace for trace in traces if "hovertemplate" in trace}
    assert set(lines) == set(SPEEDS) - ({"straightening 46°/s"} if name == "g" else set()), "never seen is left out"
    for words, trace in lines.items():
        assert trace["x"] == pytest.approx(ANGLES_DEG)
        for angle_deg, value in zip(ANGLES_DEG, trace["y"], strict=True):
            assert (value is not None) == was_seen(name, angle_deg, SPEEDS[words]), (words, angle_deg)
            assert value is None or value == pytest.approx(law(math.radians(angle_deg), SPEEDS[words]))
    count = 0
    for upper, lower in pairwise(traces):
        for angle_deg, low, high in zip(lower["x"], lower["y"], upper["y"], strict=True) if "fill" in lower else ():
            assert high - low == pytest.approx(2 * made_up_joint.half(math.radians(angle_deg)))
            row = round((angle_deg - ANGLES_DEG[0]) / 1.5)
            assert any(trace["y"][row] == pytest.approx((low + high) / 2) for trace in lines.values())
            count += 1
    assert count == sum(value is not None for trace in lines.values() for value in trace["y"])
    assert sum(trace["line"]["dash"] == "dot" for trace in traces) == sum(
        None in trace["y"] for trace in lines.values()
    )
    listed = [trace["name"] for trace in traces if trace["showlegend"]]
    assert listed == ["95 % band", "dotted: not seen", *lines], "each once"


def test_all_seen_needs_no_dots_and_no_band_none_of_it() -> None:
    joint = made_up_joint.joint()
    ones = [[1] * len(row) for row in joint["seen_g"]]
    bare = {key: value for key, value in joint.items() if "lower" not in key and "upper" not in key}
    for drawn in joint_charts.joint_figures({"joint": {**bare, "seen_g": ones, "seen_h": ones}}).values():
        assert len(drawn["data"]) == 5 and all(trace["line"]["dash"] == "solid" for trace in drawn["data"])
    for document in ({}, {"joint": {}}, {"joint": {"g": [[1.0]]}}):
        assert joint_charts.joint_figures(document) == {}
    assert (joint_charts.STILL_RAD_S, joint_charts.FAST_RAD_S) == (joint_plan.SLOW_RAD_S, joint_plan.FAST_RAD_S)


# ---- drawn -----------------------------------------------------------------------------------------------------------

LINE = figure(
    axis("Time (s)"), [axis("Torque (N·m)"), axis("Width (µs)")],
    [curve([0.0, 10.0, 20.0], [0.0, 1.0, None], "<a> & $b$", "model"),
     curve([0.0, 10.0], [1.0, 2.0], "var(--worst)", "width", panel=1)],
    names=[fig.name(5.0, "<i>&"), fig.badge(6.0, "1", "worst")], shares=(1, 1),
)  # fmt: skip


def words_of(picture: str) -> set[str | None]:
    return {text.text for text in ElementTree.fromstring(picture).iter("{http://www.w3.org/2000/svg}text")}


@pytest.mark.parametrize("name", NAMES)
def test_a_still_is_whole_svg_with_its_axes_in_colours_of_the_page(name: str) -> None:
    picture = str(svg(figures()[name], 760.0, label="<x> & more"))
    root = ElementTree.fromstring(picture)
    assert root.attrib["aria-label"] == "<x> & more" and root.attrib["viewBox"].startswith("0 0 760 ")
    words = " ".join(filter(None, words_of(picture)))
    labels = [value["title"]["text"] for value in axes(figures()[name]).values()]
    assert all(part in words for label in labels for part in label.split(" ("))
    assert "style=" not in picture and " id=" not in re.sub(r"<(clipPath|path) id=", "", picture)
    assert not re.search(r"#[0-9a-f]{6}\b", picture) and "var(--" in picture, "a colour would stay light in the dark"
    assert "var(--" not in svg(figures()[name], 760.0, light=True)


def test_words_of_a_recording_are_words() -> None:
    words = words_of(str(svg(LINE)))
    assert {"‹i›&", "‹a› & $b$", "var( --worst)", "1"} <= words
    assert "‹i›&" not in words_of(str(svg(LINE, 300.0))), "a narrow chart has no room for names"
    assert fig.in_light(LINE)["data"][1]["name"] == "var( --worst)"


def test_files_open() -> None:
    assert [file(LINE, kind)[:4] for kind in ("svg", "pdf", "png")] == [b"<svg", b"%PDF", b"\x89PNG"]


def test_a_still_is_small_and_loses_no_peak() -> None:
    assert len(svg(figures()["overview"], 760.0)) < 45_000, "it stands in the page"
    y = [math.sin(0.9 * k) for k in range(2000)]
    y[777] = 5.0
    peaks = [float(at) for at in re.findall(r"[ML][-\d.]+ ([-\d.]+)", svg(figure(
        axis("Time (s)"), [axis("Torque (N·m)", limits=(-2.0, 8.0))], [curve(range(2000), y, "", "model")]
    )))]  # fmt: skip
    assert min(peaks) < min(sorted(peaks)[10:]) - 50, "the one at 5 of a range of 10 stands out"


def test_a_notebook_draws_in_light_colours_and_a_free_effect_with_its_bands() -> None:
    lines = {name: {"value": [0.0, one], "lower": [0.0, 0.9 * one], "upper": [0.0, 1.1 * one]}
             for name, one in (("opening", 1.0), ("speed", 0.5))}  # fmt: skip
    found = object.__new__(identify.Diagnosis)
    entry = {"at": [0.0, 0.5], "lines": lines, "driver": "time (s)", "axis": "opening <a href='x'>"}
    found.__dict__["free"] = (entry,)
    drawn: Any = plot(found)
    assert [trace.y for trace in drawn.data if trace.name in lines] == [(0.0, 1.0), (0.0, 0.5)]
    assert [trace.y for trace in drawn.data if trace.fill] == [(0.0, 0.9), (0.0, 0.45)]
    assert drawn.layout.yaxis.title.text == "opening ‹a href='x'›" and "var(" not in str(drawn)
    found.__dict__["free"] = ()
    with pytest.raises(identify.BadRequest, match="free effect"):
        plot(found)


# ---- pages -----------------------------------------------------------------------------------------------------------

service = shared_service()


def test_reports_have_the_joint_and_pages_of_other_models_do_not(service: Service, client: httpx.Client) -> None:
    with service.client() as http:
        test = play_test(http, "J1")
        both = http.post("/v1/participants/J1/models", json={"recordings": [test["recording_id"]]})
        assert both.status_code == 201, both.text
    for model, count in ((both.json()["id"], 2), (test["model_id"], 0)):
        page = client.get(f"/models/{model}").text
        assert page.count('data-figure="joint_') == count and ("joint_g.svg" in page) == bool(count)
        assert client.get(f"/models/{model}/report").text.count("<svg") == 3 + count

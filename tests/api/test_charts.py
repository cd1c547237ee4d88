"""What is taken away is what was there: CSV of a recording, the report's pictures, the ramp's two directions."""

from __future__ import annotations

import json
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stimrig import identify
from stimrig.api.charts import diagnosis_charts, joint_charts, model_charts
from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import LIGHT, in_light, interpolate
from stimrig.api.charts.strokes import ticks
from stimrig.api.charts.svg import svg
from stimrig.api.sessions import joint_plan
from stimrig.api.workers.curves import curves
from tests.api import made_up_joint
from tests.api.conftest import REAL, Service, play_test, run_test, serving, shared_service
from tests.api.fake_rig import default_widths, muscle

Done = tuple[httpx.Client, dict[str, Any], Path]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[Done]:
    """A test's recording and model, by what a real worker does."""
    folder = tmp_path_factory.mktemp("export")
    with serving(folder, short_dir, REAL) as (_, client):
        client.timeout = 120
        client.post("/v1/participants", json={"code": "P1"})
        yield client, run_test(client, "P1", 120.0), folder


def test_csv_of_a_recording_is_the_recording(done: Done, tmp_path: Path) -> None:
    client, document, folder = done
    answer = client.get(f"{document['recording_url']}/csv")
    assert answer.headers["content-type"].startswith("text/csv")
    assert f"{document['recording_id']}.csv" in answer.headers["content-disposition"]
    path = tmp_path / "out.csv"
    path.write_bytes(answer.content)
    ours, theirs = identify.read(path), identify.read(folder / "recordings" / f"{document['recording_id']}.h5")
    np.testing.assert_allclose(ours.time_s, theirs.time_s, atol=1e-6)
    np.testing.assert_allclose(ours.pulse_width_us, theirs.pulse_width_us, rtol=1e-6)
    np.testing.assert_allclose(ours.torque_nm, theirs.torque_nm, rtol=1e-6, atol=1e-9)
    assert ours.segment_names == theirs.segment_names
    assert client.get("/v1/recordings/none/csv").status_code == 404
    again = client.post("/v1/participants/P1/recordings", content=answer.content).json()
    fits = again["model"]["fit_percent"], document["fit"]["fit_percent"]
    assert abs(fits[0] - fits[1]) < 0.2, "it can be taken in again and says the same"
    back = client.get(f"/v1/recordings/{again['recording_id']}/csv")
    assert back.content == answer.content


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


def test_both_directions_of_the_ramp_lie_on_the_curve_of_a_muscle_without_hysteresis() -> None:
    document, drawn = measured()
    found = model_charts.ramp_points(document, drawn)
    known = document["recruitment"]
    for points in found.values():
        curve = [interpolate(width, known["pulse_width_us"], known["torque_nm"]) for width in points["pulse_width_us"]]
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
    assert {"ramp up", "ramp down"} <= {trace["name"] for trace in figure["data"]}


def test_a_recording_without_a_ramp_has_no_directions() -> None:
    document, drawn = measured()
    still = {**drawn, "pulse_width_us": [0.0, 200.0] * (len(drawn["time_s"]) // 2), "time_s": drawn["time_s"]}
    assert model_charts.ramp_points(document, still) == {}
    assert model_charts.ramp_points(document, {**drawn, "time_s": [0.0]}) == {}


def test_still_pictures_are_whole_svg_with_the_values_in_their_place() -> None:
    document, drawn = measured()
    for name, figure in model_charts.model_figures(document, drawn).items():
        picture = ElementTree.fromstring(str(svg(figure, 600.0, label=f"<{name}> & more")))
        texts = {text.text for text in picture.iter("{http://www.w3.org/2000/svg}text")}
        assert figure["layout"]["xaxis"]["title"]["text"] in texts
        assert picture.attrib["aria-label"] == f"<{name}> & more"
    line = {"type": "scatter", "x": [0, 10], "y": [0.0, 1.0], "name": "a", "line": {"color": "#000", "width": 1}}
    figure = {"data": [line], "layout": {"height": 200, "xaxis": {}, "yaxis": {}}}
    (path,) = ElementTree.fromstring(str(svg(figure, 300.0))).iter("{http://www.w3.org/2000/svg}path")
    start, end = points(path.attrib["d"])
    assert start[0] < end[0] <= 300 and start[1] > end[1] >= 0, "up is up"


def points(way: str) -> list[tuple[float, float]]:
    """The corners of a still's path without a gap, px."""
    found: list[tuple[float, float]] = []
    for step in way.removeprefix("M").split("l"):
        dx, dy = (float(part) for part in re.findall(r"-?[\d.]+", step))
        x, y = found[-1] if found else (0.0, 0.0)
        found.append((x + dx, y + dy))
    return found


def test_a_still_is_as_small_as_what_a_screen_shows_and_loses_no_peak() -> None:
    """A line of 20 000 points, and one peak of a single point in it."""
    y = [math.sin(0.9 * k) for k in range(20_000)]
    y[7_777] = 5.0
    line = {"type": "scatter", "x": list(range(20_000)), "y": y, "name": "a", "line": {"color": "#000", "width": 1}}
    figure = {"data": [line], "layout": {"height": 200, "xaxis": {}, "yaxis": {}}}
    picture = str(svg(figure, 300.0))
    (path,) = ElementTree.fromstring(picture).iter("{http://www.w3.org/2000/svg}path")
    corners = points(path.attrib["d"])
    assert len(corners) <= 2 * 300 and len(picture) < 12_000
    highest = min(corners, key=lambda corner: corner[1])
    others = sorted(y for x, y in corners if abs(x - highest[0]) > 1)
    assert highest[1] < others[0] - 50 and abs((highest[0] - 62) / (300 - 62 - 14) - 7_777 / 20_000) < 0.01
    assert max(x for x, _y in corners) <= 300 - 14 + 0.1, "rounding does not add up"


def test_a_still_has_stairs_gaps_dashes_and_markers_as_the_chart_has() -> None:
    stairs = {"x": [0, 1, 2], "y": [1.0, 3.0, 3.0], "name": "a", "line": {"color": "#000", "width": 1, "shape": "hv"}}
    dashed = {"x": [0, 1, 2], "y": [1.0, None, 2.0], "name": "b", "mode": "lines+markers",
              "line": {"color": "#111", "width": 1, "dash": "longdash"},
              "marker": {"symbol": "diamond", "size": 6}}  # fmt: skip
    picture = str(svg({"data": [stairs, dashed], "layout": {"height": 200, "xaxis": {}, "yaxis": {}}}, 300.0))
    first, second, *diamonds = re.findall(r'<path d="(M[^"]*)"', picture)
    (x0, y0), (x1, y1), (x2, y2), (_x3, y3) = points(first)
    assert x0 < x1 and x1 == pytest.approx(x2) and y0 == pytest.approx(y1) and y1 > y2 and y2 == pytest.approx(y3)
    assert second.count("M") == 2 and picture.count('stroke-dasharray="11 4"') == 2, "in the legend, too"
    assert len(diamonds) == 3 and all(way.endswith("Z") for way in diamonds)


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.2, 7.9), (0.001, 0.004), (0.0, 47.7)])
def test_ticks_are_round_and_within(low: float, high: float) -> None:
    found = ticks(low, high, 5)
    assert 2 <= len(found) <= 11 and low - 1e-9 <= found[0] and found[-1] <= high + 1e-9
    assert np.ptp(np.diff(found)) < 1e-9


# ---- What charts say under the pointer, in which colours, and that one time axis carries the measurement


@pytest.fixture(scope="module")
def figures() -> dict[str, Any]:
    """All figures of a made-up muscle's model page."""
    document, drawn = measured()
    found = model_charts.model_figures(document, drawn)
    rows = [{"label": label, "rms_nm": rms, "held_out_rms_nm": rms, "noise_sd_nm": 0.04, "current": False}
            for label, rms in (("base", 0.12), ("+ fatigue", 0.05))]  # fmt: skip
    signatures = {"seen_nm": [0.1, 0.2], "expected_nm": [0.1, 0.1]}
    series = {"time_s": [0.0, 1.0], "residual_nm": [0.01, 0.02], "noise_band_nm": 0.08}
    segments = [{"name": "prbs", "start_s": 0.0, "end_s": 1.0}]
    return {
        **found,
        "residual": diagnosis_charts.residual({"series": series}, segments, []),
        "signature": diagnosis_charts.signature([0.0, 1.0], signatures),
        "falling": diagnosis_charts.falling(rows),
    }


def said(figure: dict[str, Any]) -> dict[str, str]:
    """Hover text of each trace that has one."""
    return {line["name"]: line["hovertemplate"] for line in figure["data"] if "hovertemplate" in line}


def test_no_line_goes_through_the_pause_between_two_recordings() -> None:
    document, drawn = measured()
    assert model_charts.broken_at_pauses(drawn) is drawn, "one recording has no pause"
    half = len(drawn["time_s"]) // 2
    slow_s = [t if place < half else drawn["time_s"][half] + 1.0 * (place - half)
              for place, t in enumerate(drawn["time_s"])]  # fmt: skip
    assert model_charts.broken_at_pauses({**drawn, "time_s": slow_s})["time_s"] == slow_s
    paused = {**drawn, "time_s": [t + 600.0 * (place >= half) for place, t in enumerate(drawn["time_s"])]}
    figure = model_charts.model_figures(document, paused)["comparison"]
    for trace in figure["data"]:
        assert len(trace["x"]) == len(trace["y"]) == len(drawn["time_s"]) + 1
        middle_s = sum(paused["time_s"][half - 1 : half + 1]) / 2
        assert trace["y"][half] is None and trace["x"][half] == pytest.approx(middle_s)
        assert len(trace.get("customdata", trace["x"])) == len(trace["x"])
    assert "NaN" not in svg(figure)


def test_every_line_that_is_seen_says_its_unit(figures: dict[str, Any]) -> None:
    for name, figure in figures.items():
        for line in figure["data"]:
            if line.get("hoverinfo") == "skip":
                continue
            unit = "" if name == "step" else "µs" if line["name"] == "pulse width" else "N·m"
            assert unit in line["hovertemplate"] and "<extra></extra>" in line["hovertemplate"], (name, line["name"])
    directions = said(figures["recruitment"])
    assert directions["ramp up"].startswith("ramp up %{y:.2f} N·m") and "ramp down" in directions
    assert "± %{customdata}" in directions["model"] and "± %{customdata}" in said(figures["step"])["model"]


def test_a_curves_band_is_said_at_the_curves_own_points() -> None:
    band = {"at": [0.0, 10.0], "whole_lower": [1.0, 2.0], "whole_upper": [1.2, 2.6]}
    found = fig.hover_band("model", fig.TORQUE, [0.0, 5.0, 10.0, 12.0], band, "at")
    assert found["customdata"] == ["0.10", "0.20", "0.30", "0.30"]
    assert "±" not in fig.hover_band("model", fig.TORQUE, [0.0], {}, "at")["hovertemplate"]


def test_each_time_has_the_segment_it_lies_in() -> None:
    segments = [{"name": name, "start_s": start} for name, start in (("a", 0.0), ("b", 1.0), ("c", 2.0))]
    assert fig.name_segments([0.0, 0.9, 1.0, 1.5, 2.0, 9.0], segments, str.upper) == ["A", "A", "B", "B", "C", "C"]
    assert fig.name_segments([0.0], [], str.upper) == [""]


def test_figures_hold_roles_and_no_colours(figures: dict[str, Any]) -> None:
    """A colour in a figure would stay light in the dark."""
    for name, figure in figures.items():
        kept = json.dumps({**figure, "data": [{**line, "x": [], "y": []} for line in figure["data"]]})
        assert re.findall(r'"#[0-9a-fA-F]{3,8}"|"rgba?\((?!0,0,0,0)[^"]*"', kept) == [], name
        light = json.dumps(in_light(figure))
        assert "var(" not in light and LIGHT["ink"] in light


# ---- The charts of g and h: the document's own numbers, bands where the joint was seen, dotted where it was not


JOINT = made_up_joint.joint()
ANGLES_DEG = [20 + 1.5 * k for k in range(61)]
SPEEDS = {"not moving": 0.0, "bending 23°/s": 0.4, "bending 46°/s": 0.8,
          "straightening 23°/s": -0.4, "straightening 46°/s": -0.8}  # fmt: skip
"""What the legend says, and the velocity it stands for, rad/s: of each way the one that was seen most."""
NEAR_DEG = 3.0


@pytest.fixture(scope="module")
def of_joint() -> dict[str, Any]:
    return joint_charts.joint_figures({"joint": JOINT})


def drawn(figure: dict[str, Any]) -> dict[str, list[float | None]]:
    """The solid lines."""
    lines = [each for each in figure["data"] if "hovertemplate" in each]
    assert all(each["x"] == pytest.approx(ANGLES_DEG) for each in lines)
    return {each["name"]: each["y"] for each in lines}


def was_seen(name: str, angle_deg: float, velocity_rad_s: float) -> bool:
    """By the arm's own law, near an angle and anywhere in the way of moving."""
    law = getattr(made_up_joint, f"seen_{name}")
    near = [angle for angle in made_up_joint.ANGLES_RAD if abs(math.degrees(angle) - angle_deg) <= NEAR_DEG + 1e-6]
    return any(law(angle, velocity_rad_s) for angle in near)


@pytest.mark.parametrize("name", ["g", "h"])
def test_lines_are_the_documents_numbers_where_the_joint_was_seen(of_joint: dict[str, Any], name: str) -> None:
    law = made_up_joint.g if name == "g" else made_up_joint.h_nm
    lines = drawn(of_joint[f"joint_{name}"])
    wanted = set(SPEEDS) - ({"straightening 46°/s"} if name == "g" else set())
    assert set(lines) == wanted, "a way that was never seen is left out"
    for words, y in lines.items():
        for angle_deg, value in zip(ANGLES_DEG, y, strict=True):
            there = was_seen(name, angle_deg, SPEEDS[words])
            assert (value is not None) == there, (words, angle_deg)
            assert value is None or value == pytest.approx(law(math.radians(angle_deg), SPEEDS[words]))
        assert any(value is not None for value in y)


def test_bands_are_the_documents_and_nowhere_else(of_joint: dict[str, Any]) -> None:
    for name, figure in of_joint.items():
        edges = [each for each in figure["data"] if each["line"]["width"] == 0]
        assert [each.get("fill") for each in edges] == [None, "tonexty"] * (len(edges) // 2)
        lines = drawn(figure)
        count = 0
        for upper, lower in zip(edges[::2], edges[1::2], strict=True):
            assert upper["x"] == lower["x"]
            for angle_deg, high, low in zip(upper["x"], upper["y"], lower["y"], strict=True):
                half = made_up_joint.half(math.radians(angle_deg))
                assert high - low == pytest.approx(2 * half), (name, angle_deg)
                row = ANGLES_DEG.index(pytest.approx(angle_deg))
                middles = [y[row] for y in lines.values() if y[row] is not None]
                assert any(value == pytest.approx((high + low) / 2) for value in middles), (name, angle_deg)
                count += 1
        assert count == sum(value is not None for y in lines.values() for value in y), "each seen point has its band"


def test_the_rest_of_a_line_is_dotted_and_the_legend_says_so(of_joint: dict[str, Any]) -> None:
    for name, figure in of_joint.items():
        dotted = [each for each in figure["data"] if each["line"].get("dash") == "dot"]
        *whole, told = dotted
        assert told["name"] == "dotted: not seen" and told["y"] == [None]
        part = [y for y in drawn(figure).values() if None in y]
        assert len(whole) == len(part) > 0, name
        assert all(each["hoverinfo"] == "skip" and len(each["y"]) == len(ANGLES_DEG) for each in whole)
        shown = [each["name"] for each in figure["data"] if each.get("showlegend", True)]
        assert shown == ["95 % band", *drawn(figure), "dotted: not seen"], "each once"


def test_all_seen_needs_no_dots_and_no_band_none_of_it() -> None:
    bare = {key: value for key, value in JOINT.items() if "lower" not in key and "upper" not in key}
    ones = [[1] * len(row) for row in JOINT["seen_g"]]
    found = joint_charts.joint_figures({"joint": {**bare, "seen_g": ones, "seen_h": ones}})
    for figure in found.values():
        assert len(figure["data"]) == 5 and "dash" not in str(figure["data"])
        assert all("±" not in each["hovertemplate"] for each in figure["data"])


@pytest.mark.parametrize("document", [{}, {"joint": {}}, {"joint": {"g": [[1.0]]}}])
def test_a_model_of_a_joint_at_rest_has_none(document: dict[str, Any]) -> None:
    assert joint_charts.joint_figures(document) == {}


def test_ways_to_move_are_those_of_the_guided_tests() -> None:
    assert (joint_charts.STILL_RAD_S, joint_charts.FAST_RAD_S) == (joint_plan.SLOW_RAD_S, joint_plan.FAST_RAD_S)


# ---- the page ----------------------------------------------------------------------------------------------------


service = shared_service()


@pytest.fixture(scope="module")
def models(service: Service) -> tuple[str, str]:
    """Of a joint at rest, and with g and h."""
    with service.client() as http:
        test = play_test(http, "J1")
        both = http.post("/v1/participants/J1/models", json={"recordings": [test["recording_id"]]})
        assert both.status_code == 201, both.text
        return test["model_id"], both.json()["id"]


def test_reports_have_them_and_pages_of_other_models_do_not(client: httpx.Client, models: tuple[str, str]) -> None:
    at_rest, moving = models
    for path, count in ((f"/models/{moving}", 2), (f"/models/{at_rest}", 0)):
        page = client.get(path).text
        assert page.count('data-figure="joint_') == count and ("joint_g.json" in page) == bool(count)
    assert client.get(f"/models/{moving}/report").text.count("<svg") == 5
    assert client.get(f"/models/{at_rest}/report").text.count("<svg") == 3

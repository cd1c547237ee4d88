"""Charts: their data (values, bands, units), and how they are drawn."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stimrig import identify
from stimrig.api.charts import diagnosis_charts, joint_charts, model_charts
from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import LIGHT, Axis, Figure, Line, Note
from stimrig.api.charts.interactive import for_plotly
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
def figures() -> dict[str, Figure]:
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


# ---- data ------------------------------------------------------------------------------------------------------------


def test_the_measurement_is_torque_residual_and_pulse_width_on_one_axis() -> None:
    document, drawn = measured()
    large, overview = figures()["comparison"], figures()["overview"]
    lines = large.lines()
    torque, predicted, left, width = (
        lines[name] for name in ("measured", "model, free run", "measured − model", "pulse width")
    )
    assert torque.y == drawn["torque_nm"] and predicted.y == drawn["predicted_torque_nm"]
    numbers = [np.array(line.y, dtype=float) for line in (torque, predicted, left)]
    assert np.allclose(numbers[0] - numbers[1], numbers[2], atol=1e-5) and width.y == drawn["pulse_width_us"]
    assert [line.panel for line in (torque, predicted, left, width)] == [0, 0, 1, 2] and width.step
    noise = next(mark for mark in large.marks if isinstance(mark, fig.Shade) and mark.panel == 1)
    assert noise.end == pytest.approx(2 * document["fit"]["noise_sd_nm"])
    assert [*overview.lines()] == [*lines][:3] and overview.height <= 320
    assert [mark for mark in large.marks if isinstance(mark, fig.Note)][-1].words.startswith("Check")


def test_no_line_goes_through_the_pause_between_two_recordings() -> None:
    _document, drawn = measured()
    half = len(drawn["time_s"]) // 2
    first, second = drawn["time_s"][:half], drawn["time_s"][half:]
    slow = {**drawn, "time_s": [*first, *(second[0] + place for place in range(len(second)))]}
    assert model_charts.broken_at_pauses(slow) is slow, "slower sampling is no pause"
    paused = {**drawn, "time_s": [*first, *(moment_s + 600.0 for moment_s in second)]}
    broken = model_charts.measurement(paused, None)
    for line in broken.lines().values():
        assert len(line.x) == len(line.y) == len(drawn["time_s"]) + 1 and line.y[half] is None
        assert line.x[half] == pytest.approx((paused["time_s"][half - 1] + paused["time_s"][half]) / 2)
    assert "nan" not in broken.svg().lower()


def test_the_error_falls_to_the_noise() -> None:
    drawn = figures()["falling"]
    fitted, held_out = (drawn.lines()[name] for name in ("fitted pulses", "held-out pulses"))
    assert fitted.y == held_out.y == [0.12, 0.05]
    assert [mark.at for mark in drawn.marks if isinstance(mark, fig.Rule)] == [0.04]
    assert [words for _at, words in drawn.x.ticks] == ["1. base", "2. + fatigue"]


def test_the_band_of_a_curve_is_that_of_the_document() -> None:
    known = measured()[0]["uncertainty"]["bands"]["recruitment"]
    band = figures()["recruitment"].marks[0]
    assert (band.x, band.lower, band.upper) == tuple(known[key] for key in
                                                     ("pulse_width_us", "whole_lower", "whole_upper"))  # fmt: skip


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
    law, drawn = made_up_joint.g if name == "g" else made_up_joint.h_nm, figures()[f"joint_{name}"]
    lines = {words: line for words, line in drawn.lines().items() if line.dash == "solid"}
    assert set(lines) == set(SPEEDS) - ({"straightening 46°/s"} if name == "g" else set()), "never seen is left out"
    for words, line in lines.items():
        assert line.x == pytest.approx(ANGLES_DEG)
        for angle_deg, value in zip(ANGLES_DEG, line.y, strict=True):
            assert (value is not None) == was_seen(name, angle_deg, SPEEDS[words]), (words, angle_deg)
            assert value is None or value == pytest.approx(law(math.radians(angle_deg), SPEEDS[words]))
    count = 0
    for band in [mark for mark in drawn.marks if isinstance(mark, fig.Band)]:
        for angle_deg, low, high in zip(band.x, band.lower, band.upper, strict=True):
            assert high - low == pytest.approx(2 * made_up_joint.half(math.radians(angle_deg)))
            row = round((angle_deg - ANGLES_DEG[0]) / 1.5)
            assert any(line.y[row] == pytest.approx((low + high) / 2) for line in lines.values())
            count += 1
    assert count == sum(value is not None for line in lines.values() for value in line.y)
    dotted = [mark for mark in drawn.marks if isinstance(mark, Line) and mark.dash == "dot"]
    assert len(dotted) == sum(None in line.y for line in lines.values())
    listed = [mark.label for mark in drawn.marks if isinstance(mark, Line | fig.Band) and mark.listed and mark.label]
    assert listed == ["95 % band", "dotted: not seen", *lines], "each once"


def test_all_seen_needs_no_dots_and_no_band_none_of_it() -> None:
    joint = made_up_joint.joint()
    ones = [[1] * len(row) for row in joint["seen_g"]]
    bare = {key: value for key, value in joint.items() if "lower" not in key and "upper" not in key}
    for drawn in joint_charts.joint_figures({"joint": {**bare, "seen_g": ones, "seen_h": ones}}).values():
        assert len(drawn.marks) == 5 and {mark.dash for mark in drawn.marks} == {"solid"}
    for document in ({}, {"joint": {}}, {"joint": {"g": [[1.0]]}}):
        assert joint_charts.joint_figures(document) == {}
    assert (joint_charts.STILL_RAD_S, joint_charts.FAST_RAD_S) == (joint_plan.SLOW_RAD_S, joint_plan.FAST_RAD_S)


# ---- drawn -----------------------------------------------------------------------------------------------------------

LINE = Figure(
    Axis("Time (s)"), [Axis("Torque (N·m)"), Axis("Width (µs)")],
    [Line([0.0, 10.0, 20.0], [0.0, 1.0, None], "<a href='x'> & $b$"), Line([0.0, 10.0], [1.0, 2.0], "_w", panel=1),
     Note(5.0, "<i>&"), Note(6.0, "1", "worst")], shares=(1, 1),
)  # fmt: skip


def words_of(picture: str) -> set[str | None]:
    return {text.text for text in ElementTree.fromstring(picture).iter("{http://www.w3.org/2000/svg}text")}


@pytest.mark.parametrize("name", NAMES)
def test_a_still_is_whole_svg_with_units_in_colours_of_the_page(name: str) -> None:
    drawn = figures()[name]
    picture = str(drawn.svg(760.0, label="<x> & more"))
    root = ElementTree.fromstring(picture)
    assert root.attrib["aria-label"] == "<x> & more" and root.attrib["viewBox"].startswith("0 0 760 ")
    labels = [axis.label for axis in (drawn.x, *drawn.panels) if not axis.ticks]
    assert all(re.search(r" \(.+\)$", label) for label in labels), labels
    words = " ".join(filter(None, words_of(picture)))
    assert all(part in words for label in labels for part in label.split(" ("))
    assert "style=" not in picture and " id=" not in re.sub(r"<(clipPath|path) id=", "", picture)
    assert not re.search(r"#[0-9a-f]{6}\b", picture), "a colour would stay light in the dark"
    assert set(re.findall(r"var\(--([\w-]+)\)", picture)) <= set(LIGHT)
    assert "var(--" not in drawn.svg(760.0, light=True)


def test_words_of_a_recording_are_words() -> None:
    words = words_of(str(LINE.svg()))
    assert {"<i>&", "<a href='x'> & $b$", "w", "1"} <= words
    assert "<i>&" not in words_of(str(LINE.svg(300.0))), "a narrow chart has no room for names"


def test_plotly_gets_the_lines_in_roles_without_links_and_without_its_upload() -> None:
    marks = [
        Line((0.0, 1.0), (1.0, None), '<a href="x">torque</a> var(--ink)', "measured", step=True),
        fig.Band((0.0, 1.0), (0.0, 0.0), (2.0, 3.0)),
        fig.Shade("grid", 0.2, 0.4),
        fig.Rule(1.5, "limit"),
        Note(0.5, "prbs"),
        Line((0.0,), (3.0,), "width", panel=1, marker="o", width=0.0),
    ]
    shown = for_plotly(Figure(fig.time_axis(0, 1), (Axis("Torque (N·m)"), Axis("Width (µs)")), marks, 400, (2, 1)), "m")
    torque, band, width = shown["data"]
    assert torque["y"] == [1.0, None] and torque["line"]["shape"] == "hv" and "N·m" in torque["hovertemplate"]
    assert torque["line"]["color"] == "var(--measured)" and "<" not in torque["name"]
    assert band["y"] == [2.0, 3.0, 0.0, 0.0] and width["yaxis"] == "y2" and width["mode"] == "markers"
    assert len(shown["layout"]["shapes"]) == 2 and len(shown["layout"]["annotations"]) == 1
    upper, lower = (shown["layout"][name]["domain"] for name in ("yaxis", "yaxis2"))
    assert upper[1] == 1.0 and upper[0] > lower[1] and upper[1] - upper[0] == pytest.approx(2 * (lower[1] - lower[0]))
    assert shown["config"]["showSendToCloud"] is False and shown["config"]["plotlyServerURL"] == ""
    assert shown["config"]["modeBarButtons"] == [["toImage"], ["zoom2d", "pan2d", "resetScale2d"]]


def test_files_open(tmp_path: Path) -> None:
    for kind, begins in (("svg", b"<svg"), ("pdf", b"%PDF"), ("png", b"\x89PNG")):
        LINE.save(tmp_path / f"line.{kind}")
        assert (tmp_path / f"line.{kind}").read_bytes().startswith(begins)
    with pytest.raises(ValueError, match=r"\.pdf"):
        LINE.save(tmp_path / "line.exe")


def test_a_still_is_small_and_loses_no_peak() -> None:
    assert len(figures()["overview"].svg(760.0)) < 45_000, "it stands in the page"
    y = [math.sin(0.9 * k) for k in range(2000)]
    y[777] = 5.0
    drawn = Figure(Axis("Time (s)"), [Axis("Torque (N·m)", (-2.0, 8.0))], [Line(range(2000), y)]).svg()
    peaks = [float(at) for at in re.findall(r"[ML][-\d.]+ ([-\d.]+)", drawn)]
    assert min(peaks) < min(sorted(peaks)[10:]) - 50, "the one at 5 of a range of 10 stands out"


def test_a_notebook_draws_a_free_effect_with_its_bands_in_light_colours() -> None:
    lines = {name: {"value": [0.0, one], "lower": [0.0, 0.9 * one], "upper": [0.0, 1.1 * one]}
             for name, one in (("opening", 1.0), ("speed", 0.5))}  # fmt: skip
    found = object.__new__(identify.Diagnosis)
    found.__dict__["free"] = ({"at": [0.0, 0.5], "lines": lines, "driver": "time (s)", "axis": "opening"},)
    drawn = plot(found)
    assert [line.y for line in drawn.lines().values()] == [[0.0, 1.0], [0.0, 0.5]]
    assert [mark.lower for mark in drawn.marks if isinstance(mark, fig.Band)] == [[0.0, 0.9], [0.0, 0.45]]
    assert drawn._repr_html_().startswith("<svg") and "var(" not in drawn._repr_html_()
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
        assert client.get(f"/models/{model}/report").text.count('class="still"') == 4 + count

"""What charts say under the pointer, in which colours, and that one time axis carries the measurement."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest

from stimrig.api.charts import diagnosis_charts, model_charts
from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import LIGHT, in_light
from stimrig.api.charts.svg import svg
from stimrig.api.language import using
from tests.api.test_export import measured


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


def test_the_measurement_says_time_torque_residual_width_and_segment(figures: dict[str, Any]) -> None:
    figure = figures["comparison"]
    assert said(figure) == {
        "measured": "measured %{y:.2f} N·m · %{customdata}<extra></extra>",
        "model, free run": "model %{y:.2f} N·m<extra></extra>",
        "measured − model": "measured − model %{y:+.3f} N·m<extra></extra>",
        "pulse width": "pulse width %{y:.0f} µs<extra></extra>",
    }
    assert figure["layout"]["xaxis"]["unifiedhovertitle"]["text"] == "%{x:.2f} s"
    (names,) = (line["customdata"] for line in figure["data"] if line["name"] == "measured")
    assert {"Random pulses", "Ramp", "Check (not used for fitting)"} <= set(names)
    assert len(names) == len(figure["data"][0]["x"])


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


def test_torque_residual_and_width_share_one_time_axis(figures: dict[str, Any]) -> None:
    figure = figures["comparison"]
    assert {line.get("yaxis", "y") for line in figure["data"]} == {"y", "y2", "y3"}
    assert {line.get("xaxis", "x") for line in figure["data"]} == {"x"}, "a zoom moves all three"
    assert figure["layout"]["hoversubplots"] == "axis" and figure["layout"]["hovermode"] == "x unified"


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
    with using("en"):
        found = fig.hover_band("model", fig.TORQUE, [0.0, 5.0, 10.0, 12.0], band, "at")
    assert found["customdata"] == ["0.10", "0.20", "0.30", "0.30"]
    with using("de"):
        assert fig.hover_band("model", fig.TORQUE, [0.0], band, "at")["customdata"] == ["0,10"]
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


def test_a_still_on_paper_has_its_colours_and_its_words(figures: dict[str, Any]) -> None:
    figure = {**figures["falling"], "data": [{**figures["falling"]["data"][0], "name": 'fill="var(--ink)"'}] * 2}
    on_page, on_paper = str(svg(figure)), str(svg(figure, on_paper=True))
    assert 'stroke="var(--measured)"' in on_page
    assert f'stroke="{LIGHT["measured"]}"' in on_paper and on_paper.count("var(--") == 2, "words are words"


def test_compared_models_differ_in_colour_and_in_dash() -> None:
    looks = [model_charts.style(number) for number in range(model_charts.MOST)]
    assert len({look["colour"] for look in looks}) == len({look["dash"] for look in looks}) == len(looks) == 6

"""Charts: their data (values, bands, units), and how they are drawn."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stimrig import identify
from stimrig.api.charts import diagnosis_charts, joint_charts, model_charts
from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import LIGHT, SHEET, Axis, Figure, Line, Note
from stimrig.api.charts.interactive import for_plotly
from stimrig.api.charts.plot import plot
from stimrig.api.jobs.curves import curves
from stimrig.api.sessions import joint_plan
from tests.api import made_up_joint
from tests.api.browser import chart, look_closer, open_tab
from tests.api.conftest import HTML, Service, play_test, shared_service, soon
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


@pytest.mark.parametrize("second", ["levels", "a segment with a long name"])
def test_names_of_short_segments_side_by_side_do_not_overlap(second: str) -> None:
    """As the default test plays them, in the first screen of a model's page."""
    matplotlib = pytest.importorskip("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    times_s = {"prbs": (2.0, 8.3), second: (8.3, 14.7), "ramp": (17.7, 27.7), "validate": (29.7, 36.7)}
    segments = [{"name": name, "start_s": start, "end_s": end} for name, (start, end) in times_s.items()]
    segments.append({"name": "rest", "start_s": 36.7, "end_s": 38.7})
    drawn = Figure(fig.time_axis(0.0, 38.7), [Axis("Torque (N·m)")], model_charts.segment_marks(segments))
    with matplotlib.rc_context(fig.SETTINGS):
        paper = fig._lay_out(drawn, 712.0, 320.0, fig.Figures.TOOLS_PX, dict.fromkeys(LIGHT, "black"))
        renderer = FigureCanvasAgg(paper).get_renderer()
        boxes = [text.get_window_extent(renderer) for text in paper.axes[0].texts]
    assert all(left.x1 < right.x0 for left, right in pairwise(boxes))
    assert len(boxes) == (4 if second == "levels" else 3)


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
    margin, above = shown["layout"]["margin"], shown["layout"]["legend"]["y"] - 1.0
    assert above * (400 - margin["t"] - margin["b"]) > 18, "the legend stands above the notes"
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


# ---- Every text can be read in light and in dark: contrast ratio and relative luminance as in WCAG 2.2.


LUMINANCE = (0.2126, 0.7152, 0.0722)
SURFACES = ("card", "paper", "soft", "chart")
TEXT = [
    *((ink, surface) for surface in SURFACES for ink in ("ink", "dim", "accent")),
    *((ink, kind + "-bg") for kind in ("good", "warn", "bad") for ink in (kind, "ink", "dim")),
    ("on-strong", "stimulate"), ("on-strong", "stop"),
    ("on-primary", "accent"), ("bad", "card"), ("mark", "chart"), ("on-worst", "worst"), ("card", "good"),
]  # fmt: skip
"""Ink and what it stands on."""
SEEN = [
    *((part, surface) for part in ("edge", "stop", "stimulate", "accent") for surface in ("card", "paper")),
    *((part, "card") for part in ("good", "warn", "cursor")),
    *((f"series-{k}", "chart") for k in (1, 2, 3, 4, 6)),
    *((role, "chart") for role in ("measured", "model", "residual", "width", "limit", "worst")),
]  # fmt: skip
"""Parts whose shape has to be seen (WCAG 1.4.11)."""


def contrast(*colours: str) -> float:
    """WCAG's contrast ratio of two colours, `#rgb` or `#rrggbb`."""
    luminances = []
    for colour in colours:
        digits = colour[1:] if len(colour) == 7 else "".join(2 * digit for digit in colour[1:])
        parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
        linear = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts)
        luminances.append(sum(weight * part for weight, part in zip(LUMINANCE, linear, strict=True)))
    return (max(luminances) + 0.05) / (min(luminances) + 0.05)


@pytest.mark.parametrize("mode", [0, 1], ids=["light", "dark"])
def test_text_stands_out_from_what_it_stands_on(mode: int) -> None:
    body = SHEET.read_text("utf-8").partition(":root {")[2].partition("\n}")[0]
    pairs = re.findall(r"--([\w-]+): (?:light-dark\((\S+), (\S+)\)|(\S+));", body)
    colours = {name: both or (light, dark)[mode] for name, light, dark, both in pairs}
    colours = {name: colours.get(value.removeprefix("var(--").rstrip(")"), value) for name, value in colours.items()}
    assert contrast("#767676", "#fff") == pytest.approx(4.54, abs=0.01), "the measure is the published one"
    for least, wanted in ((4.5, TEXT), (3.0, SEEN)):
        found = {pair: round(contrast(*(colours[name] for name in pair)), 2) for pair in wanted}
        assert {pair: ratio for pair, ratio in found.items() if ratio < least} == {}


# ---- Charts in a real browser: stills as they are reached, the plot library on demand --------------------------------


LAPTOP, TABLET = {"width": 1366, "height": 768}, {"width": 820, "height": 1180}


STROKE = """() => getComputedStyle(document.querySelector('[data-figure=step] .scatterlayer .js-line')).stroke"""
NAMED = """(name) => { const probe = document.createElement('i'); probe.style.color = `var(--${name})`;
  document.body.append(probe); const found = getComputedStyle(probe).color; probe.remove(); return found; }"""


@pytest.fixture(scope="module")
def model(service: Service) -> str:
    return service.play_test("B1")["model_id"]


def drawn(page: Any, service: Service, model: str, name: str) -> None:
    page.goto(f"{service.url}/models/{model}?diagnose=0")
    page.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    look_closer(page, name)


@pytest.mark.browser
def test_charts_have_the_colours_of_the_system_and_of_paper(tab: Any, service: Service, model: str) -> None:
    tab.set_viewport_size(LAPTOP)
    drawn(tab, service, model, "step")
    seen = {}
    for scheme in ("light", "dark"):
        tab.emulate_media(color_scheme=scheme)
        seen[scheme] = soon(lambda: (line := tab.evaluate(STROKE)) == tab.evaluate(NAMED, "model") and line)
    assert seen["light"] != seen["dark"]
    tab.emulate_media(media="print")
    assert tab.evaluate(NAMED, "card") == "rgb(255, 255, 255)", "paper is white"
    assert soon(lambda: tab.evaluate(STROKE) == seen["light"])


AT_REST = """() => new Promise((done) => { let last = scrollY, frames = 0;
  const look = () => { frames = scrollY === last ? frames + 1 : 0; last = scrollY;
    frames < 30 ? requestAnimationFrame(look) : done(scrollY); };
  look(); })"""
"""Where the page stands once it has stood there for thirty pictures."""


def swipe(page: Any, chart: Any) -> None:
    """A finger from the middle of the chart upwards and a little to the side."""
    box = chart.locator(".nsewdrag").first.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] - 20
    hand = page.context.new_cdp_session(page)
    for step in range(12):
        points = [{"x": x + 8 * step, "y": y - 20 * step}]
        kind = "touchMove" if step else "touchStart"
        hand.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        page.wait_for_timeout(16)
    hand.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


@pytest.mark.browser
def test_a_finger_scrolls_the_page_and_zooms_when_asked(browser: Any, service: Service, model: str) -> None:
    for page in open_tab(browser, service, has_touch=True, is_mobile=True):
        page.set_viewport_size(TABLET)
        drawn(page, service, model, "residual")
        chart = page.locator("[data-figure=residual]")
        chart.scroll_into_view_if_needed()
        before = page.evaluate(AT_REST)
        swipe(page, chart)
        assert page.evaluate(AT_REST) > before + 100
        state = "() => document.querySelector('[data-figure=residual] .plot').layout.dragmode"
        assert page.evaluate(state) is False
        chart.locator(".modebar-btn[data-val=zoom]").click()
        assert page.evaluate(state) == "zoom"
        before = page.evaluate(AT_REST)
        assert chart.locator(".nsewdrag").first.evaluate("(plane) => getComputedStyle(plane).touchAction") == "none"
        swipe(page, chart)
        assert page.evaluate(AT_REST) == before, "this finger draws a box"
        page.wait_for_function(f"() => ({state})() === false")
        assert chart.locator(".nsewdrag").first.evaluate("(plane) => getComputedStyle(plane).touchAction") == "auto"


# ---- stills, and the plot library that comes when it is asked for ---------------------------------------------------

PLOTLY = "plotly.min.js"
SHAPE = """(name) => { const box = document.querySelector(`[data-figure=${name}]`), fold = box.closest("details");
  return [box.clientWidth, box.clientHeight, fold.clientHeight]; }"""
"""Of a chart and of the fold it stands in; above it a notice may come, for instance where the machine stood still."""


WEIGHT = """['navigation', 'resource'].flatMap((kind) => performance.getEntriesByType(kind))
  .reduce((sum, entry) => sum + entry.encodedBodySize, 0)"""


@pytest.mark.browser
def test_a_page_is_light_until_a_chart_is_taken_hold_of(tab: Any, service: Service, model: str) -> None:
    tab.set_viewport_size(LAPTOP)
    tab.goto(f"{service.url}/models/{model}?diagnose=0")
    chart(tab, "overview")
    for _ in range(2):  # it is never quiet: it asks what the rig does
        tab.wait_for_event("request", lambda request: request.url.endswith("/rig/now"))
    asked = [url for url in tab.requests if "/figures/" in url or PLOTLY in url]
    assert asked == [], "the first chart stands in the page, and the others are folded"
    assert tab.evaluate(WEIGHT) < 80_000, "with the curves of a real record about 90 kB"
    assert "application/json" not in tab.content()
    tab.locator("#curves > summary").click()
    chart(tab, "recruitment")
    chart(tab, "step")  # beside it: the fold has its height once both are there
    before = tab.evaluate(SHAPE, "recruitment")
    assert any("recruitment.html" in url for url in tab.requests) and not any(PLOTLY in url for url in tab.requests)
    look_closer(tab, "recruitment")
    assert tab.evaluate(SHAPE, "recruitment") == before, "nothing jumps"
    assert tab.locator("[data-figure=recruitment] > svg.still").count() == 0
    assert any("recruitment.json" in url for url in tab.requests) and any(PLOTLY in url for url in tab.requests)
    assert not any("step.json" in url or "comparison" in url for url in tab.requests), "one chart's lines alone"


def test_charts_are_private_kept_and_asked_about_again(service: Service, model: str) -> None:
    with service.client() as http:
        page = http.get(f"/models/{model}", headers=HTML).text
        assert '<noscript><img class="still" src="' in page, "pictures where scripts are off"
        at = f"/models/{model}/figures/comparison"
        still = http.get(at + ".html?width=900")
        assert still.headers["cache-control"] == "private, no-cache" and 'viewBox="0 0 900 720"' in still.text
        again = http.get(at + ".html?width=900", headers={"If-None-Match": still.headers["etag"]})
        assert again.status_code == 304 and not again.content
        assert len(still.content) < 60_000 and "var(--" in still.text
        kept = http.get(at + ".svg")
        assert kept.headers["content-type"].startswith("image/svg+xml") and "var(--" not in kept.text
        assert {"data", "layout", "config"} == set(http.get(at + ".json").json())
        for wrong in ("none.svg", "comparison.exe", "comparison.pdf", "comparison"):
            assert http.get(f"/models/{model}/figures/{wrong}").status_code == 404
        assert http.get(at + ".svg?width=5").status_code == 422
    with service.client(None) as http:
        for kind in ("html", "svg", "json"):
            assert http.get(f"{at}.{kind}", headers={"If-None-Match": still.headers["etag"]}).status_code == 401

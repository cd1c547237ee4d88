"""The charts of g and h: the document's own numbers, bands where the joint was seen, dotted where it was not."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest

from stimrig.api.charts import joint_charts
from stimrig.api.charts.svg import svg
from stimrig.api.language import using
from stimrig.api.sessions import joint_plan
from tests.api import made_up_joint
from tests.api.browser import open_tab
from tests.api.conftest import Service, run_test, shared_service
from tests.api.test_axe import examined
from tests.api.test_chart_boxes import COVERED, LAPTOP

JOINT = made_up_joint.joint()
ANGLES_DEG = [20 + 1.5 * k for k in range(61)]
SPEEDS = {"not moving": 0.0, "bending 23°/s": 0.4, "bending 46°/s": 0.8,
          "straightening 23°/s": -0.4, "straightening 46°/s": -0.8}  # fmt: skip
"""What the legend says, and the velocity it stands for, rad/s: of each way the one that was seen most."""
NEAR_DEG = 3.0


@pytest.fixture(scope="module")
def figures() -> dict[str, Any]:
    with using("en"):
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
def test_lines_are_the_documents_numbers_where_the_joint_was_seen(figures: dict[str, Any], name: str) -> None:
    law = made_up_joint.g if name == "g" else made_up_joint.h_nm
    lines = drawn(figures[f"joint_{name}"])
    wanted = set(SPEEDS) - ({"straightening 46°/s"} if name == "g" else set())
    assert set(lines) == wanted, "a way that was never seen is left out"
    for words, y in lines.items():
        for angle_deg, value in zip(ANGLES_DEG, y, strict=True):
            there = was_seen(name, angle_deg, SPEEDS[words])
            assert (value is not None) == there, (words, angle_deg)
            assert value is None or value == pytest.approx(law(math.radians(angle_deg), SPEEDS[words]))
        assert any(value is not None for value in y)


def test_bands_are_the_documents_and_nowhere_else(figures: dict[str, Any]) -> None:
    for name, figure in figures.items():
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


def test_the_rest_of_a_line_is_dotted_and_the_legend_says_so(figures: dict[str, Any]) -> None:
    for name, figure in figures.items():
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
    with using("en"):
        found = joint_charts.joint_figures({"joint": {**bare, "seen_g": ones, "seen_h": ones}})
    for figure in found.values():
        assert len(figure["data"]) == 5 and "dash" not in str(figure["data"])
        assert all("±" not in each["hovertemplate"] for each in figure["data"])


@pytest.mark.parametrize("document", [{}, {"joint": {}}, {"joint": {"g": [[1.0]]}}])
def test_a_model_of_a_joint_at_rest_has_none(document: dict[str, Any]) -> None:
    assert joint_charts.joint_figures(document) == {}


def test_the_pointer_reads_value_and_band_in_the_pages_language() -> None:
    with using("de"):
        line = next(
            each for each in joint_charts.joint_figures({"joint": JOINT})["joint_h"]["data"] if "hovertemplate" in each
        )
    assert line["hovertemplate"].endswith("%{y:.2f} N·m ± %{customdata}<extra></extra>")
    assert line["customdata"][0] == f"{made_up_joint.half(math.radians(20)):.2f}".replace(".", ",")


def test_ways_to_move_are_those_of_the_guided_tests() -> None:
    assert (joint_charts.STILL_RAD_S, joint_charts.FAST_RAD_S) == (joint_plan.SLOW_RAD_S, joint_plan.FAST_RAD_S)


def test_figures_are_drawn_on_paper_with_every_name(figures: dict[str, Any]) -> None:
    for figure in figures.values():
        picture = str(svg(figure, 760.0, 215.0, on_paper=True))
        ends = [
            float(at) + 6.3 * len(words)
            for at, words in re.findall(r'<text x="([\d.]+)" y="14.0"[^>]*>([^<]+)', picture)
        ]
        assert len(ends) == len([each for each in figure["data"] if each.get("showlegend", True)])
        assert max(ends) < 780 and "var(" not in picture


# ---- the page ----------------------------------------------------------------------------------------------------


service = shared_service()


@pytest.fixture(scope="module")
def models(service: Service) -> tuple[str, str]:
    """Of a joint at rest, and with g and h."""
    with service.client() as http:
        http.post("/v1/participants", json={"code": "J1"})
        test = run_test(http, "J1")
        both = http.post("/v1/participants/J1/models", json={"recordings": [test["recording_id"]]})
        assert both.status_code == 201, both.text
        return test["model_id"], both.json()["id"]


def opened(page: Any, service: Service, model: str) -> None:
    page.goto(f"{service.url}/models/{model}?diagnose=0")
    page.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    for name in ("joint_g", "joint_h"):
        page.locator(f"[data-figure={name}] .modebar-btn").first.wait_for()


def test_reports_have_them_and_pages_of_other_models_do_not(service: Service, models: tuple[str, str]) -> None:
    at_rest, moving = models
    with service.client() as http:
        for path, count in ((f"/models/{moving}", 2), (f"/models/{at_rest}", 0)):
            page = http.get(path).text
            assert page.count('data-figure="joint_') == count and ('"joint_g"' in page) == bool(count)
        assert http.get(f"/models/{moving}/report").text.count("<svg") == 5
        assert http.get(f"/models/{at_rest}/report").text.count("<svg") == 3


@pytest.mark.browser
@pytest.mark.parametrize(("language", "scheme"), [("en", "dark"), ("de", "light")])
def test_the_page_is_examined(
    browser: Any, service: Service, models: tuple[str, str], language: str, scheme: str
) -> None:
    for page in open_tab(browser, service, color_scheme=scheme):
        page.context.add_cookies([{"name": "stimrig_language", "value": language, "url": service.url}])
        page.set_viewport_size(LAPTOP)
        opened(page, service, models[1])
        assert page.evaluate(COVERED) == []
        examined(page, f"joint, {scheme}")
        assert page.evaluate(COVERED) == [], "on a phone"
        for name in ("joint_g", "joint_h"):
            box = page.locator(f"[data-figure={name}] .nsewdrag").first.bounding_box()
            assert box["height"] > 150 and box["width"] > 180, "the legend leaves the lines room"
        assert page.errors == []

"""What stands in the first screen of a model's page, measured in the browser; what is folded, and how it opens."""

from __future__ import annotations

from typing import Any

import pytest

from tests.api.browser import chart, expected
from tests.api.conftest import Service, shared_service

pytestmark = pytest.mark.browser
LAPTOP, TABLET = (1366, 768), (820, 1180)
FIRST = {
    "verdict": ".verdict-words h2",
    "approve": "button:text-is('Approve')",
    "chart": "[data-figure=overview]",
    "missing": ".missing li",
    "add": ".missing button",
}
"""What a person needs to decide, without scrolling."""


service = shared_service(speed=8.0, emulated=True)


@pytest.fixture(scope="module")
def model(service: Service) -> str:
    return service.play_test("F1")["model_id"]


def show(tab: Any, address: str, size: tuple[int, int]) -> None:
    tab.set_viewport_size({"width": size[0], "height": size[1]})
    tab.goto(address)
    chart(tab, "overview")


def places(tab: Any) -> Any:
    """Where two parts stand in the first screen; above it a notice may come, where the machine stood still."""
    return tab.evaluate("""() => [".verdict", "#torque"].map((place) => {
      const { x, y, width, height } = document.querySelector(place).getBoundingClientRect();
      return [x, y - document.querySelector(".first-screen").getBoundingClientRect().y, width, height]; })""")


def test_verdict_chart_and_missing_effect_stand_in_the_first_screen(tab: Any, service: Service, model: str) -> None:
    for size in (LAPTOP, TABLET):
        show(tab, f"{service.url}/models/{model}", size)
        tab.locator(".missing li").wait_for()
        expected(tab.get_by_text("Emulated rig")).to_be_visible()  # with the strip that takes the most room
        expected(tab.locator("#page-old")).to_be_hidden()
        for what, place in FIRST.items():
            box = tab.locator(place).first.bounding_box()
            assert box["y"] >= 0 and box["y"] + box["height"] <= size[1], (what, box)
        wide, whole = (tab.locator(place).bounding_box()["width"] for place in (".decide .tracking", ".decide > form"))
        assert wide == whole, "what is approved has the whole column: else it is long beside an empty half"
    assert tab.evaluate("scrollY") == 0
    assert tab.locator(".first-screen .primary").count() == 1, "one button is the first one"


@pytest.mark.parametrize("size", [LAPTOP])
def test_a_diagnosis_under_way_moves_nothing(tab: Any, service: Service, size: tuple[int, int]) -> None:
    marker = service.data / "recordings" / "slow"
    marker.write_text("0.4")
    try:
        slow = service.play_test("F2")["model_id"]
        show(tab, f"{service.url}/models/{slow}", size)
        meter = tab.locator("#why progress")
        meter.wait_for()
        expected(tab.locator("#page-old")).to_be_hidden()
        box = meter.bounding_box()
        assert box["y"] + box["height"] <= size[1]
        before = places(tab)
    finally:
        marker.unlink()
        tab.get_by_role("button", name="Cancel").click()
        tab.get_by_role("link", name="Diagnose now").wait_for()
    tab.get_by_role("link", name="Diagnose now").click()
    tab.locator(".missing li").wait_for()
    chart(tab, "overview")
    tab.wait_for_load_state()  # until then the browser scrolls to the place that the address names
    tab.evaluate("scrollTo(0, 0)")
    assert places(tab) == before


def test_a_link_to_a_folded_part_opens_it(tab: Any, service: Service, model: str) -> None:
    show(tab, f"{service.url}/models/{model}", LAPTOP)
    link = tab.locator(".missing").get_by_role("link", name="Fatigue")
    link.click()
    chart(tab, "signature-fatigue")
    tab.locator("#effect-fatigue > summary").click()
    assert not tab.locator("#effect-fatigue .effect-body").is_visible()
    link.click()
    tab.locator("#effect-fatigue .effect-body").wait_for()
    tab.goto(f"{service.url}/models/{model}?again#experiment")
    tab.get_by_role("button", name="Run it now").wait_for()


def test_paper_shows_all_with_its_charts(tab: Any, service: Service, model: str) -> None:
    show(tab, f"{service.url}/models/{model}", LAPTOP)
    tab.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert tab.locator("details:not([open])").count() == 0
    for figure in ("recruitment", "step", "comparison", "residual"):
        assert tab.locator(f"[data-figure={figure}] > svg.still").count() == 1, "a print waits for nothing"
    tab.evaluate("dispatchEvent(new Event('afterprint'))")
    assert not tab.locator("#curves").evaluate("part => part.open")

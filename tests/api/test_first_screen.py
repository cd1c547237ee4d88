"""What is folded on a model's page, how it opens, and that paper shows all of it."""

from __future__ import annotations

from typing import Any

import pytest

from tests.api.browser import chart
from tests.api.conftest import Service, shared_service

pytestmark = pytest.mark.browser


service = shared_service(speed=8.0, emulated=True)


@pytest.fixture(scope="module")
def model(service: Service) -> str:
    return service.play_test("F1")["model_id"]


def show(tab: Any, address: str) -> None:
    tab.set_viewport_size({"width": 1366, "height": 768})
    tab.goto(address)
    chart(tab, "overview")


def test_a_link_to_a_folded_part_opens_it(tab: Any, service: Service, model: str) -> None:
    show(tab, f"{service.url}/models/{model}")
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
    show(tab, f"{service.url}/models/{model}")
    tab.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert tab.locator("details:not([open])").count() == 0
    for figure in ("recruitment", "step", "comparison", "residual"):
        assert tab.locator(f"[data-figure={figure}] > svg.still").count() == 1, "a print waits for nothing"
    tab.evaluate("dispatchEvent(new Event('afterprint'))")
    assert not tab.locator("#curves").evaluate("part => part.open")

"""The trend in a browser: readable on a laptop, figures under the pointer, a click to the model, no violation."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from tests.api.conftest import Service, shared_service
from tests.harness import sessions
from tests.harness.muscle import Patient
from tests.harness.sessions import Planned

pytest.importorskip("axe_playwright_python.base")
from tests.api.test_axe import examined

pytestmark = pytest.mark.browser
LAPTOP = {"width": 1366, "height": 768}
COUNT = 20


service = shared_service()


@pytest.fixture(scope="module")
def ids(service: Service) -> list[str]:
    context = service.app.state.context
    return sessions.make(context.store, context.settings.recordings_dir, "P017", sessions.weeks(COUNT))


def test_twenty_sessions_fit_a_laptop_and_lead_to_their_models(tab: Any, service: Service, ids: list[str]) -> None:
    tab.set_viewport_size(LAPTOP)
    tab.goto(service.url + "/participants/P017/trend")
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
    pictures = tab.locator("svg.trend")
    assert pictures.count() == 9
    lowest = max(pictures.nth(k).bounding_box()["y"] + pictures.nth(k).bounding_box()["height"] for k in range(9))
    assert lowest <= LAPTOP["height"]  # all of them in the first screen
    dots = [pictures.nth(1).locator(f".dot{kind}").count() for kind in ("", ".hollow")]
    assert dots == [COUNT, sum(not one.approved for one in sessions.weeks(COUNT))]
    column = pictures.nth(1).locator(".column").nth(6)
    column.hover()
    told = tab.locator("#tip").inner_text()
    assert re.search(r"Plateau [\d.]+ ± [\d.]+\s*N·m", told) and "approved by Ada" in told and "baclofen" in told
    assert tab.locator(".column.here").count() == 9  # the same session in every picture
    column.click()
    tab.wait_for_url(f"**/models/{ids[6]}")
    assert tab.errors == []


def test_notes_are_text_and_pictures_have_no_markup_of_theirs(tab: Any, service: Service, ids: list[str]) -> None:
    context = service.app.state.context
    evil = '"><script>document.title="x"</script><img src=x onerror="document.title=1">'
    planned = [Planned(Patient(), 0.0), Planned(replace(Patient(), gain=5.0), 3.0, notes={"electrodes": evil})]
    sessions.make(context.store, context.settings.recordings_dir, "P018", planned)
    tab.goto(service.url + "/participants/P018/trend")
    tab.locator("svg.trend").first.locator(".column").nth(1).hover()
    assert "<script>" in tab.locator("#tip").inner_text()
    assert tab.title() == "Trend of P018 · stimrig" and tab.locator("main img").count() == 0


def test_the_table_of_the_sessions_fits_a_laptop_in_german(tab: Any, service: Service, ids: list[str]) -> None:
    tab.context.add_cookies([{"name": "stimrig_language", "value": "de", "url": service.url}])
    tab.set_viewport_size(LAPTOP)
    tab.goto(service.url + "/participants/P017/trend")
    table = tab.locator(".scroll:has(.over-time)")
    assert table.evaluate("(box) => box.scrollWidth <= box.clientWidth")
    tab.set_viewport_size({"width": 820, "height": 1180})
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth"), "it scrolls within its own box"


def test_no_violation(tab: Any, service: Service, ids: list[str]) -> None:
    context = service.app.state.context
    sessions.make(context.store, context.settings.recordings_dir, "P020", [])
    compared = "/compare?" + "&".join(f"model={model}" for model in ids[:6])
    for path in ("/participants/P017/trend", "/participants/P020/trend", compared):
        tab.goto(service.url + path)
        examined(tab, path)
    tab.emulate_media(color_scheme="dark")
    for path in ("/participants/P017/trend", compared):
        tab.goto(service.url + path)
        examined(tab, f"{path}, dark")

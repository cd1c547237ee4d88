"""The calibration in a browser: one press of a key is one train, whatever else happens on the page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.api.browser import expected, open_tab
from tests.api.conftest import Service, shared_service

pytestmark = pytest.mark.browser


service = shared_service()


@pytest.fixture
def page(browser: Any, service: Service) -> Iterator[Any]:
    """A tab with an open calibration of K1, nothing sent yet."""
    with service.client() as http:
        http.post("/v1/participants", json={"code": "K1"})
    for tab in open_tab(browser, service):
        tab.goto(f"{service.url}/participants/K1/calibration")
        tab.get_by_role("button", name="Begin the calibration").click()
        tab.locator("#step-up").wait_for()
        tab.wait_for_load_state()  # its keys are listened to from here on
        yield tab
        with service.client() as http:
            http.post("/v1/participants/K1/calibration/discard")


def widths(service: Service) -> list[float]:
    assert service.rig.calibration is not None
    return [train.pulse_width_us for train in service.rig.calibration.trains]


def settled(page: Any, trains: int) -> None:
    """Wait until the page knows of so many trains and takes the next press."""
    expected(page.locator(".touch form").first).to_have_attribute("data-if-match", re.compile(rf"\.{trains}\."))
    expected(page.locator("#step-repeat" if trains else "#step-up")).to_be_enabled()


def press(page: Any, key: str, trains: int) -> None:
    page.keyboard.press(key)
    settled(page, trains)


def test_each_key_sends_its_train_and_marks(page: Any, service: Service) -> None:
    for count, key in enumerate(["ArrowUp", "ArrowUp", "ArrowDown", "r", "ArrowRight"], 1):
        press(page, key, count)
    assert widths(service) == [10, 20, 10, 10, 15]
    for key, following in (("Enter", "#mark-motor"), ("m", "#mark-comfort"), ("M", "#finish")):
        page.keyboard.press(key)
        page.locator(f"{following}.primary").wait_for()
        if following != "#finish":
            press(page, "ArrowUp", len(widths(service)) + 1)
    page.keyboard.press("Enter")
    page.wait_for_url("**/participants/K1")
    assert not page.errors


def test_a_press_is_one_train_and_nothing_is_kept_for_later(page: Any, service: Service) -> None:
    """Neither of a held key nor of presses while a train is asked for or played; Enter marks wherever the focus is."""
    page.keyboard.down("ArrowUp")
    for _ in range(5):
        page.keyboard.down("ArrowUp")  # what a held key sends: keydown with repeat
        page.wait_for_timeout(60)
    page.keyboard.up("ArrowUp")
    settled(page, 1)
    page.evaluate("""() => { for (const key of ['ArrowUp', 'r', 'ArrowUp', 'm'])
        document.body.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true })); }""")
    settled(page, 2)
    page.wait_for_timeout(600)
    assert widths(service) == [10, 20] and not service.rig.calibration.marks_us
    page.locator("#step-repeat").click()
    settled(page, 3)
    assert page.evaluate("document.activeElement.id") == "step-repeat"
    page.keyboard.press("Enter")  # never a second train by the button that has the focus
    page.locator("#mark-motor.primary").wait_for()
    assert len(widths(service)) == 3 and page.evaluate("document.activeElement.id") == "step-repeat"
    press(page, "ArrowUp", 4)
    assert page.evaluate("document.activeElement.id") == "step-repeat"


def test_a_key_in_a_field_sends_nothing_and_space_stops_once_also_on_a_button(page: Any, service: Service) -> None:
    page.evaluate("document.querySelector('main').insertAdjacentHTML('beforeend', '<input id=note>')")
    page.locator("#note").focus()
    page.keyboard.type("r m")
    page.keyboard.press("ArrowUp")
    page.wait_for_timeout(300)
    assert widths(service) == [] and page.locator("#note").input_value() == "r m"
    assert service.rig.state == "calibrating"
    page.locator("#step-up").focus()
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if request.method == "POST" else None)
    page.keyboard.press(" ")
    page.wait_for_url("**/stopped/**")
    assert [url.rsplit("/", 1)[1] for url in sent] == ["stop"] and service.rig.state == "latched"


def test_a_stale_page_and_one_without_an_answer_send_nothing_and_say_so(
    page: Any, service: Service, client: httpx.Client
) -> None:
    client.post("/v1/participants/K1/calibration/step", json={"direction": "up"})
    page.keyboard.press("ArrowUp")
    page.get_by_text("This page is out of date").wait_for()
    assert widths(service) == [10] and page.url.endswith("/calibration")
    settled(page, 1)
    press(page, "ArrowUp", 2)
    assert widths(service) == [10, 20] and page.get_by_text("This page is out of date").count() == 0
    page.route("**/calibration**", lambda route: route.abort())
    page.keyboard.press("ArrowUp")
    page.get_by_text("It is not known whether the train was sent").wait_for()
    assert page.locator("#calibration button:not([disabled])").count() == 0
    page.unroute("**/calibration**")
    settled(page, 2)
    press(page, "ArrowUp", 3)


def test_another_calibration_that_comes_under_the_hand_is_read_first(page: Any, service: Service) -> None:
    press(page, "ArrowUp", 1)
    with service.client() as http:
        http.post("/v1/participants/K1/calibration/discard")
        http.post("/v1/participants/K1/calibration")
    page.evaluate("""() => { window.pressable = []; new MutationObserver(() => {
        const box = document.getElementById("discard"), part = document.getElementById("refused");
        const told = part?.textContent.includes("has begun another calibration");  // the rig's bar changes at any time
        if (box && told) window.pressable.push([!box.disabled, performance.now()]);
    }).observe(document.body, { childList: true, subtree: true, attributes: true }); }""")
    page.locator("#discard").focus()
    page.keyboard.press("Enter")
    page.get_by_text("has begun another calibration").wait_for()
    page.keyboard.press("Enter")
    page.keyboard.press("ArrowUp")
    expected(page.locator("#discard")).to_be_enabled()
    seen = page.evaluate("window.pressable")
    assert not seen[0][0] and seen[-1][0]
    assert seen[-1][1] - seen[0][1] > 1000, "ms of the 2000: a pause may come before the first is seen"
    assert widths(service) == []

"""A page that cannot hear of the service says so, and since when; so does one that slept or was signed out."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest

from tests.api.browser import expected, open_tab, participant, start
from tests.api.conftest import Service, play_test, shared_service, soon

pytestmark = pytest.mark.browser
service = shared_service()
CONFIRMED = "The rig confirms that stimulation is off."
NOT_STOPPED = "No answer to stop came. Use the emergency switch on the stimulator. Then press stop again."


@pytest.fixture(scope="module")
def ids(service: Service) -> dict[str, str]:
    with service.client() as http:
        done = play_test(http, "O1")
        http.post("/v1/participants", json={"code": "O2"})
    return {"code": "O1", "model": done["model_id"], "test": done["id"]}


@pytest.fixture
def paced(browser: Any, service: Service, ids: dict[str, str]) -> Iterator[Any]:
    """A tab whose clock can be put forward: timers fire as after a machine has slept."""
    for tab in open_tab(browser, service):
        tab.clock.install()
        yield tab
        tab.context.set_offline(False)


def doubt(tab: Any) -> Any:
    return expected(tab.locator("#page-old"))


def go(tab: Any, address: str) -> None:
    """Open a page, and wait until it has asked the service and heard an answer."""
    tab.goto(address)
    expected(tab.locator("#rig-state [data-now=at]")).to_be_empty()


def press_stop(tab: Any) -> None:
    tab.get_by_role("button", name="Stop stimulation").click()


def test_every_page_says_that_the_service_is_silent_and_that_it_is_back(
    paced: Any, service: Service, ids: dict[str, str]
) -> None:
    for path in ("/participants/{code}/calibration", "/models/{model}", "/models/none"):
        go(paced, service.url + path.format(**ids))
        doubt(paced).to_be_hidden()
        paced.context.set_offline(True)
        paced.clock.fast_forward(3_000)
        doubt(paced).to_contain_text(re.compile(r"has not answered since \S*\d\d:\d\d"))
        expected(paced.locator("#rig-state")).to_contain_text("Unknown")
        assert paced.locator("#page-old").bounding_box()["y"] < 400, "it is seen without scrolling"
        paced.context.set_offline(False)
        paced.clock.fast_forward(1_000)
        doubt(paced).to_be_hidden()


def test_the_stop_button_stays_and_says_that_it_did_not_get_through(paced: Any, service: Service) -> None:
    go(paced, service.url + "/participants/O2")
    paced.context.set_offline(True)
    paced.clock.fast_forward(3_000)
    doubt(paced).to_contain_text("has not answered")
    press_stop(paced)
    doubt(paced).to_contain_text(NOT_STOPPED)
    assert service.rig.state == "ready"
    paced.context.set_offline(False)
    paced.clock.fast_forward(1_000)
    expected(paced.locator("#rig-state")).to_contain_text("No stimulation")
    doubt(paced).to_contain_text("press stop again")
    press_stop(paced)
    paced.get_by_text(CONFIRMED).wait_for()


@pytest.mark.parametrize("proxy", [False, True])
def test_a_stop_is_sent_until_a_service_that_has_just_died_is_back(tab: Any, service: Service, proxy: bool) -> None:
    """The page does not know yet that nobody answers; it stays, with its button."""
    go(tab, service.url + "/participants/O2")
    tab.route("**/stop", lambda route: route.fulfill(status=502, body="Bad Gateway") if proxy else route.abort())
    press_stop(tab)
    doubt(tab).to_contain_text("Stop is being sent")
    tab.unroute("**/stop")
    tab.get_by_text(CONFIRMED).wait_for()


def test_a_stop_gets_through_where_only_the_state_is_not_heard_of(tab: Any, service: Service) -> None:
    """The page believes that nobody answers; what it sends all the same stops."""
    service.rig.speed = 0.5
    tab.goto(service.url + "/participants/O2")
    tab.route("**/rig/now", lambda route: route.abort())
    with service.client() as http:
        http.post("/v1/tests", json={"participant": "O2"})
    doubt(tab).to_contain_text("has not answered")
    press_stop(tab)
    tab.get_by_text(CONFIRMED).wait_for()
    soon(lambda: service.rig.state == "latched")
    service.rig.speed = 30.0


def test_a_stop_without_an_answer_says_so_in_time_and_can_be_pressed_again(paced: Any, service: Service) -> None:
    go(paced, service.url + "/participants/O2")
    held: list[Any] = []
    paced.route("**/v1/stop", lambda route: held.append(route))  # and no answer ever
    paced.route("**/rig/now", lambda route: route.abort())
    paced.clock.fast_forward(3_000)
    doubt(paced).to_contain_text("has not answered")
    for presses in (1, 2):
        press_stop(paced)
        doubt(paced).to_contain_text("Stop is being sent")
        while len(held) < presses:
            paced.wait_for_timeout(20)
        paced.clock.fast_forward(4_000)
        if presses == 2:  # who presses on does not wait longer
            press_stop(paced)
        paced.clock.fast_forward(2_000)
        doubt(paced).to_contain_text(NOT_STOPPED)
    paced.unroute("**/v1/stop")
    press_stop(paced)
    paced.get_by_text(CONFIRMED).wait_for()


def test_after_an_hour_of_sleep_the_page_says_how_old_it_is(paced: Any, service: Service, ids: dict[str, str]) -> None:
    go(paced, f"{service.url}/models/{ids['model']}")
    paced.clock.fast_forward("01:00:00")
    doubt(paced).to_contain_text("heard nothing from")
    paced.evaluate("window.same = true")
    paced.get_by_role("button", name="Show it anew").click()
    doubt(paced).to_be_hidden()
    assert paced.evaluate("window.same === undefined")


def test_a_test_that_went_on_or_ended_while_the_laptop_slept(paced: Any, service: Service) -> None:
    service.rig.speed = 0.5
    participant(paced, service, "O3")
    start(paced)
    paced.locator("#age", has_text="ms").wait_for()
    paced.clock.fast_forward("01:00:00")
    expected(paced.locator("#stale")).to_be_hidden()  # it goes on
    paced.context.set_offline(True)
    expected(paced.locator("#rig-state")).to_contain_text("Unknown")
    service.rig.speed = 30.0
    soon(lambda: service.rig.state == "ready")  # it ended meanwhile
    paced.clock.fast_forward("01:00:00")
    paced.context.set_offline(False)
    paced.clock.fast_forward(3_000)
    paced.wait_for_url("**/models/*")


def test_a_session_that_ended_is_told_with_the_way_back(tab: Any, service: Service) -> None:
    go(tab, service.url + "/participants/O2?x=1")
    other = tab.context.new_page()
    other.goto(service.url + "/")
    other.get_by_role("button", name="Sign out").click()
    other.get_by_role("heading", name="Sign in").wait_for()
    doubt(tab).to_contain_text("You have been signed out.")
    way = tab.locator("#page-old").get_by_role("link", name="Sign in").get_attribute("href")
    assert way == "/sign-in?next=/participants/O2%3Fx%3D1"
    other.close()

"""A page that cannot hear of the service says so, and since when; so does one that slept or was signed out."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest

from tests.api.browser import PASSWORD, expected, open_tab, participant, start
from tests.api.conftest import Service, play_test, shared_service, soon

pytestmark = pytest.mark.browser
service = shared_service()
PAGES = ("/participants/{code}/calibration", "/models/{model}", "/tests/{test}", "/models/none")


@pytest.fixture(scope="module")
def ids(service: Service) -> dict[str, str]:
    with service.client() as http:
        done = play_test(http, "O1")
        http.post("/v1/participants", json={"code": "O2"})
    return {"code": "O1", "model": done["model_id"], "test": done["id"]}


@pytest.fixture
def paced(browser: Any, service: Service) -> Iterator[Any]:
    """A tab whose clock can be put forward: timers fire as after a machine has slept."""
    for tab in open_tab(browser, service):
        tab.clock.install()
        yield tab
        tab.context.set_offline(False)


def doubt(tab: Any) -> Any:
    return tab.locator("#page-old")


def heard_of(tab: Any) -> None:
    """The service has been asked, and has answered."""
    expected(tab.locator("#rig-state [data-now=at]")).to_be_empty()


def test_every_page_says_that_the_service_is_silent_and_that_it_is_back(
    paced: Any, service: Service, ids: dict[str, str]
) -> None:
    for path in PAGES:
        paced.goto(service.url + path.format(**ids))
        heard_of(paced)
        expected(doubt(paced)).to_be_hidden()
        paced.context.set_offline(True)
        paced.clock.fast_forward(3_000)
        expected(doubt(paced)).to_contain_text(re.compile(r"has not answered since \S*\d\d:\d\d"))
        expected(paced.locator("#rig-state")).to_contain_text("Unknown")
        assert doubt(paced).bounding_box()["y"] < 400, "it is seen without scrolling"
        paced.context.set_offline(False)
        paced.clock.fast_forward(1_000)
        expected(doubt(paced)).to_be_hidden()


def test_the_stop_button_stays_and_says_that_it_did_not_get_through(paced: Any, service: Service) -> None:
    paced.goto(service.url + "/participants/O2")
    heard_of(paced)
    paced.context.set_offline(True)
    paced.clock.fast_forward(3_000)
    expected(doubt(paced)).to_contain_text("has not answered")
    paced.get_by_role("button", name="Stop stimulation").click()
    expected(doubt(paced)).to_contain_text("No answer to stop came. Use the emergency switch")
    assert service.rig.state == "ready"
    paced.context.set_offline(False)
    paced.clock.fast_forward(1_000)
    expected(paced.locator("#rig-state")).to_contain_text("No stimulation")
    expected(doubt(paced)).to_contain_text("press stop again")
    paced.get_by_role("button", name="Stop stimulation").click()
    paced.get_by_text("The rig confirms that stimulation is off.").wait_for()


def test_a_stop_gets_through_where_only_the_state_is_not_heard_of(tab: Any, service: Service) -> None:
    """The page believes that nobody answers; what it sends all the same stops."""
    service.rig.speed = 0.5
    tab.goto(service.url + "/participants/O2")
    tab.route("**/rig/now", lambda route: route.abort())
    with service.client() as http:
        http.post("/v1/tests", json={"participant": "O2"})
    expected(doubt(tab)).to_contain_text("has not answered")
    tab.get_by_role("button", name="Stop stimulation").click()
    tab.get_by_text("The rig confirms that stimulation is off.").wait_for()
    soon(lambda: service.rig.state == "latched")
    service.rig.speed = 30.0


def test_a_stop_without_an_answer_says_so_in_time_and_can_be_pressed_again(paced: Any, service: Service) -> None:
    paced.goto(service.url + "/participants/O2")
    heard_of(paced)
    held: list[Any] = []
    paced.route("**/v1/stop", lambda route: held.append(route))  # and no answer ever
    paced.route("**/rig/now", lambda route: route.abort())
    paced.clock.fast_forward(3_000)
    expected(doubt(paced)).to_contain_text("has not answered")
    stop = paced.get_by_role("button", name="Stop stimulation")
    for press in (1, 2):
        stop.click()
        expected(doubt(paced)).to_contain_text("Stop is being sent")
        while len(held) < press:
            paced.wait_for_timeout(20)
        if press == 2:  # who presses on does not wait longer
            paced.clock.fast_forward(4_000)
            stop.click()
            paced.clock.fast_forward(2_000)
            assert "No answer to stop came" in doubt(paced).inner_text()  # now: the page's clock goes on by itself
        else:
            paced.clock.fast_forward(6_000)
        expected(doubt(paced)).to_contain_text("No answer to stop came. Use the emergency switch on the stimulator.")
    paced.unroute("**/v1/stop")
    stop.click()
    paced.get_by_text("The rig confirms that stimulation is off.").wait_for()


def test_after_an_hour_of_sleep_the_page_says_how_old_it_is(paced: Any, service: Service, ids: dict[str, str]) -> None:
    paced.goto(f"{service.url}/models/{ids['model']}")
    heard_of(paced)
    paced.clock.fast_forward("01:00:00")
    expected(doubt(paced)).to_contain_text("heard nothing from")
    paced.evaluate("window.same = true")
    doubt(paced).get_by_role("button", name="Show it anew").click()
    expected(doubt(paced)).to_be_hidden()
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
    tab.goto(service.url + "/participants/O2?x=1")
    heard_of(tab)
    other = tab.context.new_page()
    other.goto(service.url + "/")
    other.get_by_role("button", name="Sign out").click()
    other.get_by_role("heading", name="Sign in").wait_for()
    expected(doubt(tab)).to_contain_text("You have been signed out.")
    doubt(tab).get_by_role("link", name="Sign in").click()
    tab.get_by_label("Name", exact=True).fill("Ada")
    tab.get_by_label("Password").fill(PASSWORD)
    tab.get_by_role("button", name="Sign in", exact=True).click()
    tab.wait_for_url("**/participants/O2?x=1")
    other.close()

"""The rig's state is live on every page and in every tab, is never old, and there is a way back from each."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.api.browser import bring_to_rest, expected, gone, participant, start
from tests.api.conftest import Service, shared_service, soon

pytestmark = pytest.mark.browser
SPEED, SLOW = 4.0, 0.2
"""A test at SLOW lasts two minutes: each tab sees it, however busy the machine is, and a stop ends it."""
SILENT_CELL = "load cell on can0: no frame for 1.0 s"


service = shared_service(speed=SPEED, emulated=True)


@pytest.fixture
def tab(tab: Any, service: Service) -> Iterator[Any]:
    yield tab
    service.rig.mute, service.rig.cell_speaks, service.rig.device_back, service.rig.speed = False, True, True, SPEED


@pytest.fixture(scope="module")
def done(service: Service) -> dict[str, Any]:
    """A finished test with its model."""
    return service.play_test("E1")


def every_page(service: Service, done: dict[str, Any]) -> list[str]:
    """An address of each kind of page that has the bar."""
    model = done["model_id"]
    paths = (
        "/", "/participants/E1", "/participants/E1/calibration", f"/tests/{done['id']}", f"/models/{model}?diagnose=0",
        "/participants/E1/trend", "/nothing-here", "/administration",
    )  # fmt: skip
    return [service.url + path for path in paths]


def says(page: Any, words: str) -> None:
    page.locator("#rig-state", has_text=re.compile(words)).wait_for()


def test_every_page_in_every_tab_follows_the_rig(tab: Any, service: Service, done: dict[str, Any]) -> None:
    pages = [tab.context.new_page() for _ in every_page(service, done)]
    for page, address in zip(pages, every_page(service, done), strict=True):
        answer = page.goto(address)
        status = 404 if "nothing-here" in address else 403 if "administration" in address else 200
        assert answer.status == status, address
        says(page, "No stimulation ready")
        expected(page.get_by_text("Emulated rig: no person is connected")).to_be_visible()
    row = pages[0].get_by_role("row", name="E1")
    start_button = pages[1].get_by_role("button", name="Start the pre-session test")
    expected(start_button).to_be_enabled()
    service.rig.speed = SLOW
    with service.client() as http:
        test = http.post("/v1/tests", json={"participant": "E1"}).json()["id"]
    for page in pages:
        says(page, "Stimulating")
    gone(start_button)
    pages[0].reload()
    row.get_by_text("running", exact=True).wait_for()
    assert pages[1].get_by_role("link", name="test of E1").get_attribute("href") == f"/tests/{test}"
    bring_to_rest(service)
    for page in pages:
        says(page, "No stimulation ready")
    row.get_by_text("ended", exact=True).wait_for()
    expected(start_button).to_be_enabled()  # all without loading the page again


def test_back_to_a_page_that_was_loaded_before_the_start_shows_what_flows(tab: Any, service: Service) -> None:
    service.rig.speed = SLOW
    participant(tab, service, f"B{time.time_ns() % 10**9}")
    says(tab, "No stimulation")
    start(tab)
    tab.go_back()
    says(tab, "Stimulating")
    gone(tab.get_by_role("button", name="Start the pre-session test"))
    tab.go_forward()
    says(tab, "Stimulating")


def test_the_page_before_a_test_stays_once_it_is_started(tab: Any, service: Service, done: dict[str, Any]) -> None:
    """It is refused from then on; to load it again would keep the test's page from opening."""
    service.rig.speed = SLOW
    tab.goto(service.url + "/participants/E1/start")
    says(tab, "No stimulation ready")
    tab.evaluate("window.stays = true")
    with service.client() as http:
        http.post("/v1/tests", json={"participant": "E1"})
        now = soon(lambda: (now := http.get("/rig/now").json())["flow"] == "Stimulating" and now)
    expected(tab.locator("#rig-notice")).to_have_attribute("data-key", now["notice"])
    assert tab.evaluate("window.stays") is True


def test_without_an_answer_the_state_is_not_known_within_2_s(tab: Any, service: Service) -> None:
    """Nor is anything old shown as current after a sleep."""
    tab.clock.install()
    tab.goto(service.url)
    tab.clock.run_for(600)
    says(tab, "No stimulation ready")
    tab.route("**/rig/now", lambda route: route.abort())
    tab.clock.run_for(2300)  # 2 s, and the page looks every 0.25 s
    assert "Unknown" in tab.locator("#rig-state").inner_text()
    assert tab.locator("dd [data-now=torque]").inner_text() == "unknown"
    tab.unroute("**/rig/now")
    tab.clock.run_for(600)
    says(tab, "No stimulation ready")
    tab.route("**/rig/now", lambda route: route.abort())  # the line has not come back yet
    tab.clock.fast_forward("01:00:00")
    assert "Unknown" in tab.locator("#rig-state").inner_text()


def test_what_is_not_known_is_not_shown_as_known(tab: Any, service: Service) -> None:
    """A page that the browser had kept, an old torque, a rig that does not answer."""
    tab.goto(service.url)
    says(tab, "No stimulation ready")
    with tab.expect_navigation():
        tab.evaluate("dispatchEvent(new PageTransitionEvent('pageshow', {persisted: true}))")
    torque = tab.locator("dd [data-now=torque]")
    torque.get_by_text(re.compile(r"0\.43 N·m, \d\.\d s old")).wait_for()
    service.rig.cell_speaks = False
    torque.get_by_text(re.compile(r"^no torque for \d+\.\d s$")).wait_for()
    service.rig.cell_speaks = True
    torque.get_by_text("0.43 N·m").wait_for()
    service.rig.mute = True
    says(tab, "Unknown the rig does not answer")
    tab.get_by_text("Its state is unknown").wait_for()
    service.rig.mute = False
    says(tab, "No stimulation ready")


def test_a_silent_load_cell_leaves_a_way_back_on_pages_of_each_kind(tab: Any, service: Service, done: dict[str, Any]):
    for address in every_page(service, done)[1::5]:  # they share the bar, as the first test here sees
        tab.goto(address)
        says(tab, "No stimulation ready")
        service.rig_thread.become("disconnected", SILENT_CELL)
        says(tab, "Disconnected")
        tab.get_by_text(SILENT_CELL).wait_for()
        tab.get_by_text("Check the cable and the power of the load cell. Then press Reconnect").wait_for()
        tab.get_by_role("button", name="Reconnect").click()
        says(tab, "No stimulation ready")
        gone(tab.get_by_role("button", name="Reconnect"))
        if "nothing-here" not in address:
            assert tab.url == address, "back where it was pressed"


def test_another_stop_that_comes_under_the_hand_is_read_before_it_is_re_armed(tab: Any, service: Service) -> None:
    tab.goto(service.url)
    service.rig_thread.become("latched", "one")
    button = tab.get_by_role("button", name="I have checked: re-arm")
    expected(button).to_be_enabled()
    tab.evaluate("""() => { window.pressable = []; new MutationObserver(() => {
        const now = document.getElementById("rearm");
        if (now) window.pressable.push([now.dataset.ifMatch, now.querySelector("button").disabled, performance.now()]);
    }).observe(document.body, { childList: true, subtree: true, attributes: true }); }""")
    button.focus()
    for states in (("latched",), ("ready", "latched")):  # also where the notice was away between
        for state in states:
            service.rig_thread.become(state, "the same words")
            says(tab, "Stopped" if state == "latched" else "No stimulation ready")
        tab.locator(f"#rearm[data-if-match='{service.rig.latch}']").wait_for()
        expected(button).to_be_enabled()
        held = [one[1:] for one in tab.evaluate("window.pressable") if one[0] == service.rig.latch]
        assert held[0][0] is True and held[-1][0] is False
        assert held[-1][1] - held[0][1] > 1900, "ms"
        if len(states) == 1:
            expected(button).to_be_focused()


def stopped_twice(tab: Any, service: Service) -> Any:
    """The re-arm button of a first stop; then a second one, of which the page does not hear. Its time stands still."""
    tab.clock.install()
    tab.goto(service.url)
    service.rig_thread.become("latched", "one")
    button = tab.get_by_role("button", name="I have checked: re-arm")
    expected(button).to_be_enabled()
    tab.route("**/rig/now", lambda route: route.abort())
    service.rig_thread.become("latched", "two")
    soon(lambda: service.context.rig.status.latch == service.rig.latch)
    tab.clock.pause_at(tab.evaluate("Date.now()") + 60_000)
    return button


def is_read_first(tab: Any, button: Any) -> None:
    expected(button).to_be_disabled()
    tab.clock.run_for(1900)
    assert button.is_disabled()
    tab.clock.run_for(200)
    expected(button).to_be_enabled()


def test_another_stop_on_a_page_that_is_loaded_anew_is_read_first(tab: Any, service: Service) -> None:
    button = stopped_twice(tab, service)
    for _ in range(2):  # and loading it once more does not shorten that
        tab.reload()
        expected(button).to_be_disabled()
    is_read_first(tab, button)


def test_a_re_arm_refused_for_another_stop_shows_both_and_is_read_first(tab: Any, service: Service) -> None:
    stopped_twice(tab, service).click()
    row = tab.locator("#asked tbody tr")
    expected(row.locator("td").nth(0)).to_have_text("one")
    expected(row.locator("td").nth(1)).to_have_text("two")
    again = tab.get_by_role("button", name="I have seen this and checked: re-arm")
    assert service.rig.state == "latched"
    is_read_first(tab, again)
    again.click()
    soon(lambda: service.rig.state == "ready")


def test_without_scripts_the_state_carries_its_time(service: Service, pages: httpx.Client) -> None:
    shown = re.sub(r"<[^>]*>|\s+", " ", pages.get("/").text)
    assert re.search(r"No stimulation +ready +at \d\d:\d\d:\d\d", shown)
    assert re.search(r"0\.43 N·m +at \d\d:\d\d:\d\d", shown)
    service.rig_thread.become("latched", "one")
    soon(lambda: service.context.rig.status.state == "latched")
    page = pages.get("/").text
    assert re.search(r'id="rearm"><button class="primary" disabled>', page), "until a script has seen which stop it is"
    bring_to_rest(service)


def test_who_is_not_signed_in_learns_the_state_and_no_participant(service: Service, done: dict[str, Any]) -> None:
    with service.client() as http, service.client(None) as stranger:
        http.post("/v1/tests", json={"participant": "E1"})
        seen = soon(lambda: (now := stranger.get("/rig/now")).json()["flow"] == "Stimulating" and now)
        assert "E1" not in seen.text and seen.headers["cache-control"] == "no-store"
        assert http.get("/rig/now").json()["test"]["participant"] == "E1"
    bring_to_rest(service)

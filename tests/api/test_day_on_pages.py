"""A day with people on the pages: notes are written, an idle session ends."""

from __future__ import annotations

import re
from typing import Any

import httpx
import pytest

from tests.api.browser import PASSWORD, expected, participant, start
from tests.api.conftest import Service, shared_service

pytestmark = pytest.mark.browser
service = shared_service()


def test_a_note_while_the_test_runs_does_not_leave_its_page(tab: Any, service: Service) -> None:
    service.rig.speed = 1.0
    participant(tab, service, "W2")
    start(tab)
    tab.evaluate("window.same = true")
    tab.locator("#age", has_text="ms").wait_for()
    tab.get_by_label("Note (may be left empty)").fill("left hand")
    tab.get_by_role("button", name="Spasm").click()
    tab.locator("#notes-written").get_by_text("left hand").wait_for()
    assert tab.evaluate("window.same") and tab.get_by_label("Note (may be left empty)").input_value() == ""
    assert re.search(r"\d+\.\d s", tab.locator("#notes-written").inner_text())
    tab.get_by_role("button", name="Other").click()
    tab.locator("#refused", has_text="say in a few words what it is").wait_for()
    tab.get_by_role("button", name="Stop stimulation").click()
    tab.get_by_role("link", name="See what was recorded").click()
    tab.get_by_label("Time in the test (s)").fill("0,4")
    tab.get_by_label("About").select_option("posture")
    tab.get_by_role("button", name="Write it down").click()
    tab.locator("#notes-written li", has_text="Posture").get_by_text("0.4 s").wait_for()
    service.rig.speed = 30.0


def test_an_idle_session_ends_on_every_tab_and_its_page_comes_back(
    tab: Any, service: Service, client: httpx.Client
) -> None:
    client.post("/v1/participants", json={"code": "V1"})
    tab.goto(service.url + "/participants/V1?x=1")
    other = tab.context.new_page()
    other.goto(service.url + "/")
    service.sql("UPDATE page_sessions SET created_unix_s = 1, acted_unix_s = 1")
    for page in (tab, other):
        page.get_by_role("heading", name="Sign in", exact=True).wait_for()
        assert "V1" not in page.locator("body").inner_text()
        expected(page.get_by_role("button", name="Stop stimulation")).to_be_visible()
    tab.get_by_label("Name").fill("Ada")
    tab.get_by_label("Password").fill(PASSWORD)
    tab.get_by_role("button", name="Sign in", exact=True).click()
    tab.wait_for_url("**/participants/V1?x=1")
    other.close()


def test_a_persons_hand_is_told_and_a_scripts_is_not(tab: Any, service: Service) -> None:
    tab.clock.install()
    tab.goto(service.url + "/")
    tab.evaluate("document.dispatchEvent(new KeyboardEvent('keydown', {bubbles: true}))")
    tab.clock.run_for(30_000)
    assert not [url for url in tab.requests if url.endswith("/sessions/acted")]
    with tab.expect_request("**/sessions/acted"):
        tab.keyboard.press("Shift")
        tab.clock.run_for(30_000)

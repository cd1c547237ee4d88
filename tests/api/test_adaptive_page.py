"""The pages of a test that stops itself: the choice, the question, what is known by now, Enough."""

from __future__ import annotations

from typing import Any

import pytest

from tests.api.browser import participant
from tests.api.conftest import Service, own_service, wait_done

service = own_service(speed=0.25)
"""Slow enough to look at a running test from all sides."""


@pytest.mark.browser
def test_a_test_that_stops_itself_on_its_page(tab: Any, service: Service) -> None:
    participant(tab, service, "X1")
    tab.locator("[name=kind][value=adaptive]").check()
    tab.locator("[name=target]").fill("0,2")
    tab.locator("button.stimulate").first.click()
    tab.get_by_text("The target should be reached").wait_for()
    tab.locator("form.steps button.stimulate").click()
    tab.locator("#knows").wait_for()
    tab.get_by_text("Stops once both are known within 0.2 %").wait_for()
    tab.locator("#known-words", has_text="known within 8.0 %").wait_for()
    tab.locator("#least-known", has_text="140 µs").wait_for()
    assert float(tab.locator("#dose-used").inner_text()) > 0
    with service.client() as client:
        test_id = client.get("/v1/tests").json()[0]["id"]
        box = tab.get_by_role("button", name="Enough").bounding_box()
        assert box["y"] + box["height"] < 768  # of a small laptop
        tab.get_by_role("button", name="Enough").click()
        tab.locator("#enough").wait_for(state="hidden")
        document = wait_done(client, test_id)
    assert (document["state"], document["adaptive"]["ended"]) == ("completed", "enough")
    after = tab.context.new_page()  # the running test's page goes on to the model by itself, at a moment of its own
    after.goto(f"{service.url}/tests/{test_id}")
    after.get_by_text("A person said that it is enough").wait_for()
    assert tab.errors == []

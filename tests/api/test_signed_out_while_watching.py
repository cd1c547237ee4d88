"""Signed out in another tab during a test: the live page says so, its stop button works."""

from __future__ import annotations

import time
from typing import Any

import pytest

from tests.api.browser import participant, start
from tests.api.conftest import Service, shared_service

pytestmark = pytest.mark.browser


service = shared_service(speed=0.2)


def test_the_page_says_that_it_is_signed_out_and_stops_all_the_same(tab: Any, service: Service) -> None:
    participant(tab, service, f"S{time.time_ns() % 10**9}")
    start(tab)
    tab.locator("#age", has_text="ms").wait_for()
    assert not tab.locator("#stale").is_visible()
    (cookie,) = tab.context.cookies()
    service.app.state.context.auth.sign_out(cookie["value"])
    tab.locator("#stale", has_text="You are signed out").wait_for(timeout=15_000)
    tab.get_by_role("button", name="Stop stimulation").click()
    tab.get_by_text("The rig confirms that stimulation is off.").wait_for()

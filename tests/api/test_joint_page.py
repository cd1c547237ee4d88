"""The pages of a moving joint in a real browser: what they follow while a person moves the joint."""

from __future__ import annotations

import math
from typing import Any

import pytest

from tests.api.browser import after_the_end, painted_soon, participant
from tests.api.conftest import Service, own_service, soon
from tests.api.fake_arm import back_and_forth, still

pytestmark = pytest.mark.browser
LOW, HIGH = math.radians(20), math.radians(110)


service = own_service(speed=4.0)


@pytest.fixture
def sensor(service: Service) -> Service:
    service.rig.arm.way = still(math.radians(65))
    with service.client() as http:
        soon(lambda: http.get("/v1/rig").json()["angle"]["present"], 30)
    return service


def with_range(tab: Any, service: Service, code: str = "X1") -> None:
    participant(tab, service, code)
    tab.locator("#angle-0").fill("20")
    tab.locator("#angle-1").fill("110")
    with tab.expect_navigation():  # the page is loaded again once they are set
        tab.get_by_role("button", name="Set the limits").click()


def at(tab: Any, service: Service, angle_deg: float) -> None:
    """Move the joint there, and wait until the page knows."""
    service.rig.arm.way = still(math.radians(angle_deg))
    tab.locator('[data-now="angle"]', has_text=f"{angle_deg:.0f}°").first.wait_for()


def test_a_passive_test_shows_its_map_and_ends_by_itself(tab: Any, sensor: Service) -> None:
    sensor.rig.speed = 2.0  # it is still slow when a busy machine has loaded its page
    with_range(tab, sensor)
    tab.get_by_role("link", name="To the tests of the joint").click()
    tab.get_by_role("button", name="Start the passive movement…").click()
    tab.get_by_text("none: no current flows").wait_for()
    sensor.rig.arm.way = back_and_forth(LOW + 0.01, HIGH - 0.01)
    tab.get_by_role("button", name="Start now: no stimulation").click()
    tab.wait_for_url("**/tests/T*")
    tab.locator("#missing li", has_text="Bend faster from").wait_for()
    assert "Stimulating" not in tab.locator("#rig-state").inner_text(), "no current flows, so the bar says so"
    assert painted_soon(tab, "angle-chart") and painted_soon(tab, "velocity-chart")
    tab.locator("#coverage td", has_text="✓").first.wait_for()
    assert tab.locator("#angle").inner_text().endswith("°") and tab.locator("#stop").is_visible()
    assert tab.locator("#current").count() == 0, "no current flows, so none is shown"
    after_the_end(tab, "/participants/X1/joint", "Back to the joint")
    tab.locator(".step", has_text="Passive movement").get_by_text("done today").wait_for()
    assert tab.errors == []


def test_held_angles_start_only_there_and_survive_a_reload(tab: Any, sensor: Service) -> None:
    sensor.rig.speed = 0.5  # it is still playing when a busy machine has loaded its page
    with_range(tab, sensor)
    tab.goto(f"{sensor.url}/participants/X1/joint")
    start = tab.get_by_role("button", name="Start at 35°…")
    at(tab, sensor, 65)
    assert start.is_disabled()
    at(tab, sensor, 37)
    tab.locator(".held-now.is-there").wait_for()
    start.click()
    tab.get_by_text("Hold at").wait_for()
    at(tab, sensor, 50)
    assert tab.get_by_role("button", name="Start now").is_disabled(), "it left the angle before yes was said"
    at(tab, sensor, 36)
    tab.get_by_role("button", name="Start now").click()
    tab.wait_for_url("**/tests/T*")
    tab.locator("#held", has_text="Hold the joint at").wait_for()
    after_the_end(tab, "/participants/X1/joint", "Back to the joint")
    tab.get_by_role("button", name="Start at 50°…").wait_for()
    tab.reload()
    assert tab.locator(".angles .is-done").count() == 1 and tab.locator(".angles li").count() == 5
    again = tab.locator(".angles .is-done").get_by_role("button", name="again…")
    at(tab, sensor, 50)
    assert again.is_disabled()
    at(tab, sensor, 35)
    again.click()
    tab.get_by_role("heading", name="Start the held-angle test of X1?").wait_for()

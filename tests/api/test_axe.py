"""Each kind of page under axe: no violation; at every size stop is uncovered, and nothing sticks out."""

from __future__ import annotations

import json
import re
import zlib
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.api.browser import (
    PHONE,
    TABLET,
    UNCOVERED,
    WIDE,
    ZOOMED,
    chart,
    open_tab,
    participant,
    settled,
    sign_in_with_token,
    start,
)
from tests.api.conftest import Service, play_test, shared_service, soon

axe_path = pytest.importorskip("axe_playwright_python.base").AXE_FILE_PATH
pytestmark = pytest.mark.browser
service = shared_service(speed=8.0)


def violations(page: Any) -> list[str]:
    """What axe finds, rule by rule, with the elements; a still is one image, whatever it is drawn of.

    The page's own policy keeps foreign scripts out of its world.
    """
    if not page.evaluate("typeof window.axe === 'object'"):
        page.evaluate(Path(axe_path).read_text("utf-8"))
    found = page.evaluate("axe.run({exclude: [['svg.still > *']]}, {resultTypes: ['violations']})")
    assert found["passes"] or found["violations"], "it has looked at something"
    return [
        f"{entry['id']} ({entry['impact']}): {json.dumps([node['html'][:160] for node in entry['nodes'][:3]])}"
        for entry in found["violations"]
    ]


def examine(page: Any, what: str, stop: bool = True) -> None:
    """Look at all sizes; axe takes one of two, chosen by the state's name: to run it is dear."""
    look = (WIDE, PHONE)[zlib.crc32(re.sub(r"[0-9a-f-]{8,}|T[0-9-]+\w*", "", what).encode()) % 2]
    page.wait_for_load_state()
    for size in (WIDE, TABLET, ZOOMED, PHONE):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        assert soon(lambda: page.evaluate("document.documentElement.scrollWidth <= innerWidth"), 8), (what, size)
        assert size != look or violations(page) == [], (what, size)
        for scroll in ("0", "document.body.scrollHeight") if stop else ():
            page.evaluate(f"window.scrollTo(0, {scroll})")
            assert page.evaluate(UNCOVERED) and page.locator("#stop").bounding_box()["height"] >= 44, (what, size)


def visit(page: Any, service: Service, path: str, *figures: str, stop: bool = True) -> None:
    page.set_viewport_size({"width": WIDE[0], "height": WIDE[1]})
    page.goto(service.url + path)
    settled(page)
    for name in figures:
        chart(page, name)
    examine(page, path, stop)


def test_what_is_folded_fits_a_phone_once_it_is_open(tab: Any, service: Service) -> None:
    participant(tab, service, "X2")
    tab.set_viewport_size({"width": PHONE[0], "height": PHONE[1]})
    tab.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_pages_without_a_test(browser: Any, tab: Any, service: Service) -> None:
    for path in ("/", "/models/none"):
        visit(tab, service, path)
    participant(tab, service, "X1")
    tab.get_by_label("Current of every pulse").fill("1.234,5")
    tab.get_by_role("button", name="Start the pre-session test").click()
    tab.get_by_text("is not a plain number").wait_for()
    examine(tab, "limits refused")
    tab.get_by_label("Current of every pulse").fill("20")
    tab.get_by_role("button", name="Start the pre-session test").click()
    tab.get_by_role("button", name="Start now").wait_for()
    examine(tab, "before current flows")
    tab.goto(service.url + "/participants/X1/calibration")
    tab.get_by_role("button", name="Begin the calibration").click()
    tab.locator("#step-up").wait_for()
    examine(tab, "calibration")
    tab.get_by_role("button", name="Discard").click()
    for stranger in open_tab(browser, service, signed_in=False):
        visit(stranger, service, "/sign-in", stop=False)
        sign_in_with_token(stranger, service)
        stranger.get_by_role("link", name="Administration").click()
        stranger.get_by_label("Name of the controller").fill("ilc")
        stranger.get_by_role("button", name="Make the key").click()
        stranger.get_by_text("shown this once").wait_for()
        examine(stranger, "a new key")


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.campaign)])
def test_a_test_and_its_ends(browser: Any, service: Service, scheme: str) -> None:
    service.rig.speed = 0.7
    for page in open_tab(browser, service, color_scheme=scheme):
        participant(page, service, f"X2-{scheme}")
        start(page)
        page.locator("#age", has_text="ms").wait_for()
        examine(page, "live")
        service.rig.confirms_stop = False
        page.get_by_role("button", name="Stop stimulation").click()
        page.get_by_role("heading", name="The stop is not confirmed").wait_for()
        examine(page, "not confirmed")
    service.rig.speed = 8.0


def test_a_model_and_what_is_made_of_it(tab: Any, service: Service, client: httpx.Client) -> None:
    first = play_test(client, "X3")["model_id"]
    added = client.post(f"/v1/models/{first}/effects", json={"effects": ["fatigue"]}).json()["id"]
    tab.goto(f"{service.url}/models/{added}")
    settled(tab)
    tab.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    for figure in ("comparison", "recruitment", "residual", "falling"):
        chart(tab, figure)
    chart(tab, "step")
    examine(tab, "model, all open")
    visit(tab, service, f"/models/{first}/report", stop=False)
    visit(tab, service, "/participants/X3/trend")

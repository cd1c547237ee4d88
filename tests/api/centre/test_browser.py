"""The centre's pages in a browser: no violation under axe, nothing sticks out, nothing foreign is run or loaded."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from stimrig.api.charts.trend_charts import WIDE
from tests.api.browser import close, there, watched
from tests.api.centre.conftest import AT, Centre, Teller
from tests.api.conftest import TOKEN
from tests.api.test_axe import fits, violations

pytestmark = pytest.mark.browser
SIZES = ((1366, 768), (820, 1180), (390, 844))
HOSTILE = "<img src=x onerror=boom()>"


@pytest.fixture
def page(browser: Any, centre: Centre) -> Iterator[Any]:
    """A tab of the administrator."""
    page = watched(browser, accept_downloads=True)
    page.goto(f"{centre.url}/sign-in#token={TOKEN}")
    page.get_by_role("button", name="Sign in with the token").click()
    there(page, "Rigs")
    yield page
    close(page.context)


def looked_at(page: Any, what: str) -> None:
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        fits(page, f"{what} at {width}")
        assert violations(page) == [], (what, width)


def test_from_no_rig_to_a_download(page: Any, centre: Centre, told: Teller) -> None:
    looked_at(page, "no rig")
    for path in ("/participants", "/warnings", "/administration"):
        page.goto(centre.url + path)
        looked_at(page, f"empty {path}")
    page.goto(centre.url)
    page.get_by_label("Name of the rig").fill("Ward 1")
    page.get_by_role("button", name="Add, and show its key").click()
    shown = page.locator("pre.secret").inner_text()
    looked_at(page, "the key")
    key = re.findall(r"STIMRIG_CENTRE_KEY=(\S+)", shown)[0]
    for week in range(5):
        data = told.session(day=f"2026-02-0{1 + week}", number=week)
    with centre.client(key) as rig:
        rig.post("/v1/rig/hello", json=told.hello(AT, state="latched", reason=HOSTILE, version=HOSTILE))
        told.push(rig)
    page.goto(centre.url)
    page.get_by_text("latched").wait_for()
    looked_at(page, "rigs")
    page.get_by_role("link", name=re.compile("Warnings")).click()
    there(page, "Warnings")
    looked_at(page, "warnings")
    page.get_by_role("button", name="Acknowledge: The rig's clock is off").click()
    page.get_by_text("acknowledged by administrator").wait_for()
    page.get_by_role("link", name="Participants").click()
    page.get_by_label("Effect in a model").select_option("fatigue")
    page.get_by_role("button", name="Search").click()
    page.wait_for_url("**effect=fatigue**")
    looked_at(page, "participants")
    page.get_by_role("link", name="P017").click()
    page.get_by_text("5 sessions, 5 recordings").wait_for()
    looked_at(page, "participant")
    with page.expect_download() as download:
        page.locator("article.session").first.get_by_role("link", name=re.compile(r"\d\d:\d\d")).click()
    with open(download.value.path(), "rb") as file:  # noqa: PTH123
        assert file.read() == data
    x = page.evaluate("JSON.parse(document.getElementById('told').textContent)[0][0]")
    page.locator("svg.trend").first.scroll_into_view_if_needed()
    box = page.locator("svg.trend").first.bounding_box()
    page.mouse.click(box["x"] + x * box["width"] / WIDE, box["y"] + box["height"] / 2)
    page.wait_for_url(re.compile(r"before=2026-02-01"))
    assert page.errors == []
    assert {httpx.URL(url).host for url in page.requests if not url.startswith(("data:", "blob:"))} == {"127.0.0.1"}


def test_the_list_of_rigs_renews_itself(page: Any, centre: Centre) -> None:
    key = centre.key()
    page.clock.install()
    page.goto(centre.url)
    page.get_by_text("never yet").wait_for()
    with centre.client(key) as rig:
        rig.post("/v1/rig/hello", json=Teller().hello(centre.clock.utc(), state="running"))
    page.clock.run_for(11_000)
    page.get_by_text("running").wait_for()
    assert page.errors == []


def test_in_german_too(browser: Any, centre: Centre) -> None:
    context = browser.new_context(locale="de-DE")
    page = context.new_page()
    page.goto(f"{centre.url}/sign-in#token={TOKEN}")
    page.locator("#by-token button").click()
    page.get_by_role("heading", name="Messplätze").wait_for()
    page.get_by_text("Noch kein Messplatz.").wait_for()
    close(context)

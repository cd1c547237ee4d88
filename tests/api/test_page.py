"""The page in a real browser: a clinician's way, stop in every state, stale data, nothing from elsewhere."""

from __future__ import annotations

import itertools
import re
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from stimrig.api.web import pages
from tests.api.browser import (
    NARROW,
    PASSWORD,
    PHONE,
    WIDE,
    expected,
    gone,
    open_tab,
    painted_soon,
    participant,
    start,
)
from tests.api.conftest import Service, shared_service

pytestmark = pytest.mark.browser


service = shared_service(speed=8.0)


def test_a_clinicians_whole_way(tab: Any, service: Service) -> None:
    service.rig.speed = 4.0
    participant(tab, service, "P100")
    expected(tab.get_by_text("No model yet.")).to_be_visible()
    expected(tab.get_by_text("No test yet.")).to_be_visible()
    start(tab)
    tab.locator("#segment", has_text="Ramp").wait_for(timeout=20_000)
    assert painted_soon(tab, "torque-chart") > 3000 and painted_soon(tab, "width-chart") > 2000
    assert float(tab.locator("#progress").get_attribute("value") or 0) >= 0
    left = int(tab.locator("#left").inner_text().split()[0])
    assert 0 < left < 25
    expected(tab.locator("#stale")).to_be_hidden()
    service.rig.speed = 60.0
    tab.wait_for_url("**/models/M-*", timeout=60_000)
    tab.locator(".figure-box .main-svg").first.wait_for()
    tab.locator("[data-job]").wait_for(state="detached")  # the diagnosis adds more when it is ready
    assert "follows 97.9 % of the torque" in tab.inner_text("main")
    for words in ("Torque (N·m)", "Residual (N·m)", "Time (s)"):
        expected(tab.locator("#torque").get_by_text(words).first).to_be_visible()
    tab.get_by_label("Your password, once more").first.fill(PASSWORD)
    tab.get_by_role("button", name="Approve").click()
    tab.get_by_text("the controller gets this model").wait_for()
    expected(tab.get_by_text("Done. The controller has today's model until 23:59.")).to_be_visible()
    assert tab.locator(".who").inner_text().split() == ["Signed", "in:", "Ada", "clinician"]
    tab.get_by_role("link", name="P100").click()
    tab.get_by_text("in use", exact=True).wait_for()
    with service.client() as http:
        assert http.get("/v1/participants/P100/model").status_code == 200
    assert {urlsplit(url).netloc for url in tab.requests if url.startswith("http")} == {urlsplit(service.url).netloc}
    assert tab.errors == []
    service.rig.speed = 8.0


def test_stop_is_on_every_page_uncovered_and_nothing_sticks_out(tab: Any, service: Service) -> None:
    with service.client() as http:
        http.post("/v1/participants", json={"code": "P101"})
    places = itertools.product((WIDE, NARROW, PHONE), ("/", "/participants/P101", "/models/none"))
    for (width, height), path in places:
        tab.set_viewport_size({"width": width, "height": height})
        tab.goto(service.url + path)
        script = """() => { const b = document.getElementById('stop').getBoundingClientRect();
          const at = (x, y) => document.elementFromPoint(b.left + b.width * x, b.top + b.height * y);
          return [[.5, .5], [.03, .1], [.97, .9]].every(([x, y]) => at(x, y)?.id === 'stop'); }"""
        for scroll in ("0", "document.body.scrollHeight"):
            tab.evaluate(f"window.scrollTo(0, {scroll})")
            assert tab.evaluate(script), path
        assert tab.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), path
        assert tab.locator("#stop").bounding_box()["height"] >= 44


def test_stop_works_while_the_live_channel_is_cut(tab: Any, service: Service) -> None:
    participant(tab, service, f"C{time.time_ns() % 10**9}")
    tab.route_web_socket("**/live", lambda socket: socket.close())
    start(tab)
    tab.locator("#stale").wait_for(timeout=15_000)
    tab.get_by_role("button", name="Stop stimulation").click()
    tab.get_by_text("The rig confirms that stimulation is off.").wait_for()


def test_everything_needed_works_without_scripts(browser: Any, service: Service) -> None:
    for page in open_tab(browser, service, java_script_enabled=False):
        participant(page, service, f"N{time.time_ns() % 10**9}")
        start(page)
        assert "Scripts are off" in page.content() and 'http-equiv="refresh"' in page.content()
        page.get_by_role("button", name="Stop stimulation").click()
        page.get_by_text("The rig confirms that stimulation is off.").wait_for()


SEEN_STALE = """() => { const banner = document.getElementById('stale');
  new MutationObserver(() => { if (!banner.hidden) window.staleAt ??= performance.now(); })
    .observe(banner, {attributes: true}); }"""


def test_data_grow_stale_within_a_second_when_the_rig_dies(tab: Any, service: Service) -> None:
    service.rig.speed = 1.5
    participant(tab, service, f"R{time.time_ns() % 10**9}")
    start(tab)
    tab.locator("#age", has_text="ms").wait_for()
    tab.evaluate(SEEN_STALE)
    service.rig_thread.__exit__()
    tab.locator("#stale").wait_for(timeout=15_000)
    assert tab.evaluate("staleAt - state.heard") < 1000, "by the page's own clock, since the last frame"
    assert tab.locator("#live.is-stale").count() == 1
    service.rig_thread.__enter__()
    tab.get_by_text("rig's process ended").first.wait_for(timeout=30_000)


def test_keyboard_alone_reaches_stop_and_start(tab: Any, service: Service) -> None:
    participant(tab, service, f"K{time.time_ns() % 10**9}")
    reached: list[str] = []
    for _ in range(16):
        tab.keyboard.press("Tab")
        reached.append(tab.evaluate("document.activeElement.textContent.trim()"))
    assert reached[:2] == ["Skip to content", "Stop stimulation"]
    assert "Start the pre-session test" in reached


def test_two_browsers_see_the_same_test(browser: Any, tab: Any, service: Service) -> None:
    service.rig.speed = 0.5  # it runs until the second one has seen it
    participant(tab, service, f"T{time.time_ns() % 10**9}")
    start(tab)
    for second in open_tab(browser, service):
        second.get_by_role("link", name="test running").click()
        second.locator("#segment", has_text=re.compile("Random pulses|Ramp|Rest|Check")).wait_for()
        assert painted_soon(second, "torque-chart") > 1500
    service.rig.speed = 60.0


def test_limits_for_today_are_set_by_a_key(tab: Any, service: Service) -> None:
    participant(tab, service, f"L{time.time_ns() % 10**9}")
    tab.get_by_label("Current of every pulse").fill("17,5")
    tab.keyboard.press("Enter")
    tab.get_by_text("17.5 mA").wait_for()
    assert service.rig.state == "ready", "the key in the field starts nothing"


def test_a_page_that_waits_takes_nothing_away_that_somebody_writes(tab: Any) -> None:
    """Work that ends while a password is typed must not read the page anew: the next click would be lost."""
    script = (Path(pages.__file__).parent / "static" / "wait.js").read_text(encoding="utf-8")
    body = (
        '<script type="application/json" id="rig-words">{"left": "{seconds} s", "show": "Show it", "news": "News."}'
        "</script>"
        '<input id="mine"><div data-job="J"><b data-words></b><span data-left></span><progress></progress></div>'
        f"<script>{script}</script>"
    )
    job = {"progress": 0.5, "text": "at work", "time_left_s": 2.0, "done": False}
    tab.route("http://wait.test/jobs/now/J", lambda route: route.fulfill(json=job))
    tab.route("http://wait.test/", lambda route: route.fulfill(body=body, content_type="text/html"))
    tab.goto("http://wait.test/")
    tab.get_by_text("at work").wait_for()
    tab.locator("#mine").fill("half a passw")
    job["done"] = True
    tab.get_by_role("button", name="Show it").wait_for()
    assert tab.locator("#mine").input_value() == "half a passw"
    job["done"] = False
    tab.get_by_role("button", name="Show it").click()
    expected(tab.locator("#mine")).to_have_value("")
    gone(tab.get_by_role("button", name="Show it"))

"""Charts in a real browser: stills as they are reached, the plot library on demand."""

from __future__ import annotations

from typing import Any

import pytest

from tests.api.browser import chart, look_closer, open_tab
from tests.api.conftest import HTML, Service, shared_service, soon

pytestmark = pytest.mark.browser
LAPTOP, TABLET = {"width": 1366, "height": 768}, {"width": 820, "height": 1180}


LINE = """() => getComputedStyle(document.querySelector('[data-figure=step] .scatterlayer .js-line')).stroke"""
NAMED = """(name) => { const probe = document.createElement('i'); probe.style.color = `var(--${name})`;
  document.body.append(probe); const found = getComputedStyle(probe).color; probe.remove(); return found; }"""


service = shared_service()


@pytest.fixture(scope="module")
def model(service: Service) -> str:
    return service.play_test("B1")["model_id"]


def drawn(page: Any, service: Service, model: str, name: str) -> None:
    page.goto(f"{service.url}/models/{model}?diagnose=0")
    page.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    look_closer(page, name)


def test_charts_have_the_colours_of_the_system_and_of_paper(tab: Any, service: Service, model: str) -> None:
    tab.set_viewport_size(LAPTOP)
    drawn(tab, service, model, "step")
    seen = {}
    for scheme in ("light", "dark"):
        tab.emulate_media(color_scheme=scheme)
        seen[scheme] = soon(lambda: (line := tab.evaluate(LINE)) == tab.evaluate(NAMED, "model") and line)
    assert seen["light"] != seen["dark"]
    tab.emulate_media(media="print")
    assert tab.evaluate(NAMED, "card") == "rgb(255, 255, 255)", "paper is white"
    assert soon(lambda: tab.evaluate(LINE) == seen["light"])


AT_REST = """() => new Promise((done) => { let last = scrollY, frames = 0;
  const look = () => { frames = scrollY === last ? frames + 1 : 0; last = scrollY;
    frames < 30 ? requestAnimationFrame(look) : done(scrollY); };
  look(); })"""
"""Where the page stands once it has stood there for thirty pictures."""


def swipe(page: Any, chart: Any) -> None:
    """A finger from the middle of the chart upwards and a little to the side."""
    box = chart.locator(".nsewdrag").first.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] - 20
    hand = page.context.new_cdp_session(page)
    for step in range(12):
        points = [{"x": x + 8 * step, "y": y - 20 * step}]
        kind = "touchMove" if step else "touchStart"
        hand.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        page.wait_for_timeout(16)
    hand.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def test_a_finger_scrolls_the_page_and_zooms_when_asked(browser: Any, service: Service, model: str) -> None:
    for page in open_tab(browser, service, has_touch=True, is_mobile=True):
        page.set_viewport_size(TABLET)
        drawn(page, service, model, "residual")
        chart = page.locator("[data-figure=residual]")
        chart.scroll_into_view_if_needed()
        before = page.evaluate(AT_REST)
        swipe(page, chart)
        assert page.evaluate(AT_REST) > before + 100
        state = "() => document.querySelector('[data-figure=residual] .plot').layout.dragmode"
        assert page.evaluate(state) is False
        chart.locator(".modebar-btn[data-val=zoom]").click()
        assert page.evaluate(state) == "zoom"
        before = page.evaluate(AT_REST)
        assert chart.locator(".nsewdrag").first.evaluate("(plane) => getComputedStyle(plane).touchAction") == "none"
        swipe(page, chart)
        assert page.evaluate(AT_REST) == before, "this finger draws a box"
        page.wait_for_function(f"() => ({state})() === false")
        assert chart.locator(".nsewdrag").first.evaluate("(plane) => getComputedStyle(plane).touchAction") == "auto"


# ---- stills, and the plot library that comes when it is asked for ---------------------------------------------------

PLOTLY = "plotly.min.js"
SHAPE = """(name) => { const box = document.querySelector(`[data-figure=${name}]`), fold = box.closest("details");
  return [box.clientWidth, box.clientHeight, fold.clientHeight]; }"""
"""Of a chart and of the fold it stands in; above it a notice may come, for instance where the machine stood still."""


WEIGHT = """['navigation', 'resource'].flatMap((kind) => performance.getEntriesByType(kind))
  .reduce((sum, entry) => sum + entry.encodedBodySize, 0)"""


def test_a_page_is_light_until_a_chart_is_taken_hold_of(tab: Any, service: Service, model: str) -> None:
    tab.set_viewport_size(LAPTOP)
    tab.goto(f"{service.url}/models/{model}?diagnose=0")
    chart(tab, "overview")
    for _ in range(2):  # it is never quiet: it asks what the rig does
        tab.wait_for_event("request", lambda request: request.url.endswith("/rig/now"))
    asked = [url for url in tab.requests if "/figures/" in url or PLOTLY in url]
    assert asked == [], "the first chart stands in the page, and the others are folded"
    assert tab.evaluate(WEIGHT) < 80_000, "with the curves of a real record about 90 kB"
    assert "application/json" not in tab.content()
    tab.locator("#curves > summary").click()
    chart(tab, "recruitment")
    chart(tab, "step")  # beside it: the fold has its height once both are there
    before = tab.evaluate(SHAPE, "recruitment")
    assert any("recruitment.html" in url for url in tab.requests) and not any(PLOTLY in url for url in tab.requests)
    look_closer(tab, "recruitment")
    assert tab.evaluate(SHAPE, "recruitment") == before, "nothing jumps"
    assert tab.locator("[data-figure=recruitment] > svg.still").count() == 0
    assert any("recruitment.json" in url for url in tab.requests) and any(PLOTLY in url for url in tab.requests)
    assert not any("step.json" in url or "comparison" in url for url in tab.requests), "one chart's lines alone"


def test_charts_are_private_kept_and_asked_about_again(service: Service, model: str) -> None:
    with service.client() as http:
        page = http.get(f"/models/{model}", headers=HTML).text
        assert '<noscript><img class="still" src="' in page, "pictures where scripts are off"
        at = f"/models/{model}/figures/comparison"
        still = http.get(at + ".html?width=900")
        assert still.headers["cache-control"] == "private, no-cache" and 'viewBox="0 0 900 720"' in still.text
        again = http.get(at + ".html?width=900", headers={"If-None-Match": still.headers["etag"]})
        assert again.status_code == 304 and not again.content
        assert len(still.content) < 60_000 and "var(--" in still.text
        kept = http.get(at + ".svg")
        assert kept.headers["content-type"].startswith("image/svg+xml") and "var(--" not in kept.text
        assert {"data", "layout", "config"} == set(http.get(at + ".json").json())
        for wrong in ("none.svg", "comparison.exe", "comparison.pdf", "comparison"):
            assert http.get(f"/models/{model}/figures/{wrong}").status_code == 404
        assert http.get(at + ".svg?width=5").status_code == 422
    with service.client(None) as http:
        for kind in ("html", "svg", "json"):
            assert http.get(f"{at}.{kind}", headers={"If-None-Match": still.headers["etag"]}).status_code == 401

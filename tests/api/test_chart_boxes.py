"""Charts in a real browser: stills as they are reached, in the colours of the system."""

from __future__ import annotations

from typing import Any

import pytest

from tests.api.browser import chart
from tests.api.conftest import HTML, Service, shared_service, soon

pytestmark = pytest.mark.browser
LINE = """() => getComputedStyle(document.querySelector('[data-figure=step] svg.still path[stroke*=model]')).stroke"""
NAMED = """(name) => { const probe = document.createElement('i'); probe.style.color = `var(--${name})`;
  document.body.append(probe); const found = getComputedStyle(probe).color; probe.remove(); return found; }"""
WEIGHT = """['navigation', 'resource'].flatMap((kind) => performance.getEntriesByType(kind))
  .reduce((sum, entry) => sum + entry.encodedBodySize, 0)"""

service = shared_service()


@pytest.fixture(scope="module")
def model(service: Service) -> str:
    return service.play_test("B1")["model_id"]


def test_a_page_is_light_and_its_charts_come_as_they_are_reached(tab: Any, service: Service, model: str) -> None:
    tab.set_viewport_size({"width": 1366, "height": 768})
    tab.goto(f"{service.url}/models/{model}?diagnose=0")
    chart(tab, "overview")
    for _ in range(2):  # it is never quiet: it asks what the rig does
        tab.wait_for_event("request", lambda request: request.url.endswith("/rig/now"))
    assert not any("/figures/" in url for url in tab.requests), "the first charts stand in the page, others are folded"
    assert tab.evaluate(WEIGHT) < 80_000, "with the curves of a real record about 90 kB"
    tab.locator("#curves > summary").click()
    chart(tab, "recruitment")
    chart(tab, "step")
    assert not any("comparison" in url for url in tab.requests)
    seen = {}
    for scheme in ("light", "dark"):
        tab.emulate_media(color_scheme=scheme)
        seen[scheme] = soon(lambda: (line := tab.evaluate(LINE)) == tab.evaluate(NAMED, "model") and line)
    assert seen["light"] != seen["dark"]
    tab.emulate_media(media="print")
    assert tab.evaluate(NAMED, "card") == "rgb(255, 255, 255)", "paper is white"
    assert soon(lambda: tab.evaluate(LINE) == seen["light"])


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
        for wrong in ("none.svg", "comparison.exe", "comparison.json", "comparison"):
            assert http.get(f"/models/{model}/figures/{wrong}").status_code == 404
        assert http.get(at + ".svg?width=5").status_code == 422
    with service.client(None) as http:
        for kind in ("html", "svg"):
            assert http.get(f"{at}.{kind}", headers={"If-None-Match": still.headers["etag"]}).status_code == 401

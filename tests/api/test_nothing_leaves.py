"""Whatever is pressed in whatever chart, no request leaves: neither a page nor a report file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from stimrig.api.models.explanation import step_versions
from stimrig.api.models.story import story
from stimrig.api.web.pages.report_file import comparison_html, story_html
from tests.api import stub_worker
from tests.api.browser import look_closer, open_tab, settled
from tests.api.conftest import Service, play_test, shared_service

pytestmark = pytest.mark.browser
LINK = '<a href="https://elsewhere.example/">here</a>'
BUTTONS = ".js-plotly-plot :is(.modebar-btn, button, a, [role=button])"


service = shared_service(speed=8.0)


@pytest.fixture
def tab(browser: Any, service: Service) -> Iterator[Any]:
    for page in open_tab(browser, service):
        watch(page)
        yield page


def watch(page: Any) -> None:
    """Take down what any tab of the browser's asks another machine for, and what is saved here."""
    page.left, page.downloads, context = [], [], page.context
    own = urlsplit(page.url).netloc

    def stop(route: Any) -> None:
        address = urlsplit(route.request.url)
        if address.scheme in ("file", "data", "blob") or address.netloc == own:
            route.continue_()
        else:
            page.left.append(route.request.url)
            route.abort()

    context.route("**/*", stop)
    context.on("page", lambda other: page.left.append(f"a new window: {other.url}"))
    page.on("download", lambda found: page.downloads.append(found))


def press_everything(page: Any, figures: int) -> None:
    """Every button and link of every chart, then the chart itself; the picture of each is made by the browser."""
    page.locator(".js-plotly-plot .main-svg").first.wait_for()
    page.wait_for_function("n => document.querySelectorAll('.js-plotly-plot .modebar').length >= n", arg=figures)
    buttons, count = page.locator(BUTTONS), page.locator(BUTTONS).count()
    assert count >= 4 * figures
    for number in range(count):  # a press may draw a chart anew
        buttons.nth(number).click(force=True, no_wait_after=True)
    for chart in page.locator(".js-plotly-plot").all():
        for entry in chart.locator(".legendtoggle").all():
            entry.click(force=True)
            entry.dblclick(force=True)
        for plane in chart.locator(".nsewdrag").all():
            plane.click(force=True, position={"x": 20, "y": 20})
            plane.dblclick(force=True, position={"x": 30, "y": 20})
    for _ in range(600):
        if len(page.downloads) >= figures:
            break
        page.wait_for_timeout(100)
    assert len(page.downloads) == figures
    assert all(Path(download.path()).read_bytes().startswith(b"\x89PNG") for download in page.downloads)
    assert buttons.count() == count, "no press brings up another button, as to upload it"
    assert page.left == [] and page.errors == []


@pytest.mark.campaign
def test_no_request_leaves_a_page_whatever_is_pressed(tab: Any, service: Service) -> None:
    with service.client() as http:
        model = play_test(http, "N1")["model_id"]
        added = http.post(f"/v1/models/{model}/effects", json={"effects": ["fatigue"]}).json()
    added = added.get("id") or added["model"]["id"]
    paths = (f"/models/{model}?diagnose=1", f"/models/{added}?diagnose=0")
    seen: set[str] = set()
    for path in paths:
        tab.goto(service.url + path)
        if path == paths[0]:
            tab.locator("[data-figure=signature-fatigue]").first.wait_for(state="attached")
        settled(tab)
        tab.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
        tab.downloads.clear()
        names = [str(box.get_attribute("data-figure")) for box in tab.locator("[data-figure]").all()]
        look_closer(tab, *names)
        press_everything(tab, len(names))
        seen |= set(names)
    assert " ".join(sorted(seen)) == "comparison curve falling overview recruitment residual signature-fatigue step"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of each kind, of a recording that tries to bring links into its charts."""
    folder, segments = tmp_path_factory.mktemp("reports"), [{"name": LINK, "start_s": 0.0, "end_s": 20.0}]
    drawn, against = stub_worker.curves(lambda *_: None), stub_worker.comparison(lambda *_: None)
    drawn["segments"], against["where"] = segments, [{**against["where"][0], "segment": LINK, "text": LINK}]
    (folder / "compare.html").write_text(comparison_html(stub_worker.model([LINK]), drawn, LINK, None, against))
    steps = [
        {"added": added, "fit_percent": 97.0, "rms_nm": rms, "held_out_rms_nm": rms, "held_out_fit_percent": 97.0}
        for added, rms in ((None, 0.12), (LINK, 0.041))
    ]
    told = story(step_versions({"noise_sd_nm": 0.04, "steps": steps}), against, against, None, None)
    measured = {"curves": drawn, "comparison": against}
    improved = story_html(told, measured, {**measured}, LINK)
    (folder / "improve.html").write_text(improved)
    return folder


@pytest.mark.parametrize(("name", "figures"), [("compare", 4), ("improve", 3)])
def test_a_report_is_one_small_file_without_scripts_that_lets_nothing_out(
    tab: Any, files: Path, name: str, figures: int
) -> None:
    path = files / f"{name}.html"
    text = path.read_text()
    assert path.stat().st_size < 1_000_000 and "<script" not in text and "default-src &#39;none&#39;" in text
    tab.goto(path.as_uri())
    assert tab.errors == []
    assert tab.locator(".figure-box svg.still").count() == figures and "var(--" not in text.split("<svg", 1)[1]
    assert tab.locator("svg a").count() == 0, "a recording's words are words"
    tried = tab.evaluate(
        """async () => {
          const asked = await fetch('https://elsewhere.example/').then(() => 'sent', () => 'refused');
          const picture = await new Promise((done) => { const image = new Image();
            image.onload = () => done('sent'); image.onerror = () => done('refused');
            image.src = 'https://elsewhere.example/a.png'; });
          return [asked, picture]; }"""
    )
    assert tried == ["refused", "refused"] and tab.left == []

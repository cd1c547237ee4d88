"""No request leaves a report file, whatever its recording holds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from stimrig import identify
from stimrig.api.jobs.curves import curves, rounded
from stimrig.api.models.explanation import step_versions
from stimrig.api.models.story import story
from stimrig.api.web.pages.report_file import comparison_html, story_html
from tests.api.browser import open_tab
from tests.api.conftest import Service, shared_service
from tests.api.test_jobs import made_up_csv

pytestmark = pytest.mark.browser
LINK = '<a href="https://elsewhere.example/">here</a>'


service = shared_service(speed=8.0)


@pytest.fixture
def tab(browser: Any, service: Service) -> Iterator[Any]:
    for page in open_tab(browser, service):
        watch(page)
        yield page


def watch(page: Any) -> None:
    """Take down what any tab of the browser's asks another machine for."""
    page.left, context = [], page.context
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


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of each kind, of a recording that tries to bring links into its charts."""
    folder = tmp_path_factory.mktemp("reports")
    record = made_up_csv(folder / "record.csv")
    record.write_text(record.read_text().replace(",prbs", ',"' + LINK.replace('"', '""') + '"'))
    read = identify.read(record)
    model = identify.fit(read)
    drawn, against = curves(model, read), rounded(identify.compare(model, read).to_dict())
    (folder / "compare.html").write_text(comparison_html(model.to_dict(), drawn, LINK, None, against))
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

"""A hidden effect, found and added by clicking: a record of the emulator's muscle, a real fit, a real browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from bench.muscles import hidden_records
from tests.api.browser import PASSWORD, chart, expected, participant, there
from tests.api.conftest import REAL, Service, run_service
from tests.harness import few_effects

pytestmark = [pytest.mark.browser, pytest.mark.slow]
HIDDEN = ["--effects", "recruitment_hysteresis", "--seeds", "29:30", "--strengths", "strong", "--rate-hz", "80"]
PATIENCE_MS = 400_000


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[Service]:
    with few_effects.only("recruitment_hysteresis", "fatigue"):
        yield from run_service(tmp_path_factory.mktemp("clicking"), short_dir, REAL)


def error_of(row: Any) -> float:
    """Error on held-out pulses of a version's row, N·m."""
    return float(row.locator("td").nth(4).inner_text())


def test_hidden_effect_is_found_added_and_approved_by_clicking(tab: Any, service: Service, tmp_path: Path) -> None:
    assert hidden_records.main(["--out", str(tmp_path), *HIDDEN]) == 0
    (record,) = tmp_path.glob("*.csv")
    participant(tab, service, "H1")
    tab.get_by_text("Upload a recording of another tool").click()
    tab.get_by_label("or HDF5").set_input_files(record)
    tab.get_by_role("button", name="Upload and identify").click(timeout=PATIENCE_MS)
    tab.get_by_text("An effect is missing in this model").wait_for(timeout=PATIENCE_MS)
    first = tab.url.split("#")[0].split("?")[0]
    tab.locator("#missing-recruitment_hysteresis").get_by_role("link", name="Hysteresis of recruitment").click()
    chart(tab, "signature-recruitment_hysteresis")
    assert "very probably missing" in tab.locator("#missing-recruitment_hysteresis + .about").inner_text()
    tab.locator("summary", has_text="Where the error sits").click()
    assert tab.locator(".places li").count() >= 3, "the worst places are named"
    tab.locator(".do").get_by_role("button", name="Add this effect").click()
    tab.locator("summary", has_text="Error of each version").click(timeout=PATIENCE_MS)
    chart(tab, "falling")
    rows = tab.locator(".versions tbody tr")
    assert rows.count() == 2 and rows.nth(1).inner_text().startswith("2. + hysteresis of recruitment")
    assert error_of(rows.nth(1)) < 0.5 * error_of(rows.nth(0)), "the error falls to less than half on rows not seen"
    assert tab.url.split("#")[0] != first
    tab.get_by_role("link", name="Report").click()
    there(tab, "Muscle model of H1")
    expected(tab.get_by_text("+ hysteresis of recruitment")).to_be_visible()
    tab.go_back()
    if not tab.get_by_label("Your password, once more").first.is_visible():
        tab.get_by_text("Approve or reject it").click()
    tab.get_by_label("Your password, once more").first.fill(PASSWORD)
    tab.get_by_role("button", name="Approve").click()
    tab.get_by_text("the controller gets this model").wait_for()
    with service.client() as http:
        assert [e["id"] for e in http.get("/v1/participants/H1/model").json()["effects"]] == ["recruitment_hysteresis"]
    hosts = {urlsplit(url).netloc for url in tab.requests if url.startswith("http")}
    assert hosts == {urlsplit(service.url).netloc} and tab.errors == []

"""Folds stay as a person left them, a note's kind is chosen, an estimate says so, a day ends at 23:59."""

from __future__ import annotations

import re
from typing import Any

import pytest

from stimrig.api import language
from stimrig.api.models.stored_model import followed
from tests.api.conftest import Service, run_test, shared_service
from tests.api.test_access import csrf, signed_in

service = shared_service()


@pytest.fixture(scope="module")
def model(service: Service) -> str:
    with service.client() as http:
        http.post("/v1/participants", json={"code": "L1"})
        model: str = run_test(http, "L1")["model_id"]
        http.get(f"/v1/models/{model}/diagnosis")
    return model


def test_the_kind_of_a_note_is_chosen(service: Service, model: str) -> None:
    with signed_in(service) as browser:
        page = browser.get("/participants/L1").text
        assert 'name="kind" required><option value="">Choose…</option>' in page
        form = {"csrf": csrf(browser), "text": "electrode 2 moved", "kind": ""}
        refused = browser.post("/participants/L1/notes", data=form, headers={"Accept": "text/html"})
        assert refused.status_code == 422 and "Choose what the note is about" in refused.text
        assert browser.post("/participants/L1/notes", data={**form, "kind": "electrodes"}).status_code == 303
        assert [note["kind"] for note in browser.get("/v1/participants/L1/notes").json()] == ["electrodes"]


def test_what_an_effect_would_leave_is_called_an_estimate(service: Service, model: str) -> None:
    with signed_in(service) as browser:
        page = browser.get(f"/models/{model}").text
    assert "0.200 → about <b>0.042 N·m</b>" in page and "it is estimated: adding it fits the model anew" in page
    assert "with it (estimated)" in page


def test_a_day_ends_at_its_last_minute_everywhere(service: Service, model: str) -> None:
    with service.client() as http:
        ends = http.post(f"/v1/models/{model}/approve", json={"reason": "follows the measurement well"}).json()
    end = language.until(ends["expires_utc"])
    assert end.endswith("23:59") and language.when(ends["expires_utc"]).endswith("00:00")
    with signed_in(service) as browser:
        assert f"until {end}" in browser.get(f"/models/{model}").text
        assert f"until {end}" in browser.get(f"/models/{model}/report").text
    assert language.until("2026-01-02T09:30:00.000Z") == language.when("2026-01-02T09:30:00.000Z")


@pytest.mark.browser
def test_a_fold_stays_as_it_was_left(tab: Any, service: Service, model: str) -> None:
    tab.goto(f"{service.url}/models/{model}")
    fold = tab.locator("#curves")
    assert fold.get_attribute("open") is None
    fold.locator("summary").click()
    tab.locator("#figures summary").first.click()
    tab.locator("#figures summary").first.click()
    tab.wait_for_function(
        "sessionStorage.length === 1 && 'figures' in JSON.parse(sessionStorage.getItem(sessionStorage.key(0)))"
    )
    tab.reload()
    assert fold.get_attribute("open") is not None
    fold.locator("[data-figure=recruitment] .main-svg").first.wait_for()
    assert tab.locator("#figures").get_attribute("open") is None
    assert tab.errors == []


def test_new_pulses_come_first() -> None:
    both = {"fit_percent": 98.5, "ceiling_percent": 99.0, "held_out_fit_percent": 97.9}
    assert (followed(both).percent, followed(both).where) == (97.9, "On pulses not used for fitting")
    crossed = {**both, "held_out_by": "cross-validation"}
    assert followed(crossed).where == "On parts of the recording that were left out in turn"
    alone = followed({**both, "held_out_fit_percent": None})
    assert (alone.percent, alone.ceiling_percent, alone.where) == (98.5, 99.0, "On the pulses that it was fitted to")


def test_every_page_shows_the_same_fit(service: Service) -> None:
    with service.client() as http:
        http.post("/v1/participants", json={"code": "F1"})
        first, second = (run_test(http, "F1")["model_id"] for _ in range(2))
    pages = ("/", "/participants/F1", "/participants/F1/trend", f"/compare?model={first}&model={second}",
             f"/models/{first}", f"/models/{first}/report")  # fmt: skip
    with signed_in(service) as browser:
        for place in pages:
            page = browser.get(place).text
            assert "97.9" in page and 'title="On pulses not used for fitting"' in page, place
            page = re.sub(r"<(script|svg)\b.*?</\1>", "", page, flags=re.DOTALL)
            others = page.count("98.5")  # on the pulses that it was fitted to; said so where it is shown
            assert others == page.count("On fitted pulses</span><b>98.5"), place

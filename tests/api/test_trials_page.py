"""The page of a participant while a controller plays trials: what is seen, without reload, and what is asked."""

from __future__ import annotations

import re
from typing import Any

import httpx
import pytest

from api import language
from api.models.tracking_words import sentences
from tests.api.conftest import Service
from tests.api.test_access import csrf, signed_in
from tests.api.test_tracked import approved, play, say, tracked

__all__ = ["approved"]
PAGE = "/participants/P017"


def trial(**levels: tuple[float, float, float]) -> dict[str, Any]:
    usual = {"gain": (1.0, 0.9, 1.1), "threshold_shift_us": (0.0, -1.0, 1.0), "time_scale": (1.0, 0.9, 1.1)}
    now = {name: dict(zip(("value", "low", "high"), level, strict=True)) for name, level in (usual | levels).items()}
    return {"now": now, "at_utc": "2026-11-22T12:00:00.000Z", "outcome": "followed"}


@pytest.mark.parametrize(
    ("levels", "words"),
    [
        ({"gain": (0.77, 0.75, 0.79)}, "The plateau is 23 % lower than at "),
        ({"gain": (1.052, 1.01, 1.09)}, "The plateau is 5.2 % higher than at "),
        ({"threshold_shift_us": (-3.0, -4.0, -2.0)}, "The threshold is 3.0 µs lower than at "),
        ({"time_scale": (1.2, 1.1, 1.3)}, "The muscle is 20 % slower than at "),
        ({"gain": (0.77, 0.5, 1.01)}, "The muscle is as it was at "),
    ],
)
def test_only_what_the_bands_are_sure_of_is_said(levels: Any, words: str) -> None:
    (said,) = sentences([trial(), trial(**levels)], "2026-11-22T11:05:00.000Z")
    time = language.clock("2026-11-22T11:05:00.000Z")[:5]
    assert said == f"{words}{time}."


def test_a_model_of_another_day_and_no_trial() -> None:
    said = sentences([trial(gain=(0.5, 0.4, 0.6))], "2026-11-19T11:05:00.000Z")
    assert "19 Nov 2026" in said[0]
    unknown = {"now": None, "at_utc": "", "outcome": "not-followed"}
    assert sentences([], "2026-11-19T11:05:00.000Z") == sentences([unknown], "2026-11-19T11:05:00.000Z") == []


def test_the_card_tells_the_trials_without_scripts_and_in_german(
    service: Service, client: httpx.Client, approved: str
) -> None:
    assert "Number of the trial" not in client.get(PAGE).text, "only where there is something"
    for _ in range(3):
        play(client)
    say(service, reason="the record is too short")
    play(client)
    page = client.get(PAGE).text
    card = page[page.index('<section class="card trials"') :]
    assert "The plateau is 5.9 % lower than at " in card and "as of trial 3, " in card and "(just now)" in card
    assert card.count("<figure") == 3, "nobody sent a reference, so there is no tracking error"
    for unit in ("94.1 ± 1.0\u00a0%", "0.5 ± 0.0\u00a0µs", "100.0 ± 1.0\u00a0%"):
        assert unit in card, unit
    assert card.count("Number of the trial") == 3
    assert "not followed" in card and "the record is too short" in card and "Start the adaptive test" not in card
    german = client.get(PAGE, headers={"Accept-Language": "de"}).text
    assert "Das Plateau liegt 5,9 % tiefer als um " in german and "nach Versuch 3" in german
    assert client.get(f"{PAGE}/trials").text.strip() in page


def test_what_is_asked_leads_to_the_shortest_test_in_one_click(
    service: Service, client: httpx.Client, approved: str
) -> None:
    say(service, values={"gain": 0.7})
    play(client)
    with signed_in(service) as browser:
        page = browser.get(PAGE).text
        assert "The trials say that a new test is needed." in page
        notice = re.search(r'<div class="notice bad" role="alert">.*?</div>', page, re.S)
        assert notice and "After trial 1 the gain is expected to be 70.0 %" in notice[0]
        fields = dict(re.findall(r'name="(\w+)" value="([^"]*)"', notice[0]))
        asked = browser.post(f"{PAGE}/tests", data=fields)
        assert asked.status_code == 303 and "/confirm/" in asked.headers["location"]
        assert "Stops once known within" in browser.get(asked.headers["location"]).text


def test_a_person_sets_the_limits_with_the_approval(service: Service, client: httpx.Client, approved: str) -> None:
    with signed_in(service) as browser:
        client.post(f"/v1/models/{approved}/reject", json={"reason": "once more"})
        page = browser.get(f"/models/{approved}").text
        assert re.search(r'name="gain_percent"[^>]*value="20"', page)
        form = {"csrf": csrf(browser), "password": "correct horse battery"}
        for wrong in ("61", "-1", "", "1e1", "nan"):
            refused = browser.post(f"/models/{approved}/approve", data={**form, "gain_percent": wrong})
            assert refused.status_code == 422, wrong
        assert tracked(client).status_code == 404
        sent = {**form, "gain_percent": "12,5", "threshold_percent": "0", "time_scale_percent": "60"}
        assert browser.post(f"/models/{approved}/approve", data=sent).status_code == 303
        shown = browser.get(f"/models/{approved}").text
    assert "gain ±12 %, threshold not tracked, time scale ±60 %" in shown
    limits = client.get("/v1/participants/P017/tracking").json()["limits"]
    assert limits == {"gain_percent": 12.5, "threshold_percent": 0.0, "time_scale_percent": 60.0}


@pytest.mark.browser
def test_the_card_is_renewed_while_trials_are_played(
    service: Service, client: httpx.Client, approved: str, tab: Any
) -> None:
    tab.goto(service.url + PAGE)
    tab.evaluate("window.same = true")
    for number in (1, 2):
        play(client)
        tab.get_by_text(f"as of trial {number},").wait_for()
    assert tab.evaluate("window.same") is True, "without reload"
    tab.get_by_text("All trials as a table").click()
    say(service, values={"gain": 0.7})
    play(client)
    tab.get_by_role("button", name="Start the adaptive test").first.wait_for()
    tab.get_by_role("button", name="Start the adaptive test").first.click()
    tab.get_by_role("button", name="Start now").wait_for()
    assert tab.errors == []

"""The page of a participant while a controller plays trials: what is seen, without reload, and what is asked."""

from __future__ import annotations

import re
from typing import Any, get_args

import httpx
import pytest

from stimrig.api import local_time
from stimrig.api.models.tracking import OUTCOMES, sentences
from stimrig.api.web.responses.models import TrialOut
from tests.api.conftest import Service
from tests.api.test_tracked import play, say, tracked

PAGE = "/participants/P017"


def trial(number: int = 1, distance: float | None = 2.0, **levels: tuple[float, float, float]) -> dict[str, Any]:
    usual = {"gain": (1.0, 0.96, 1.04), "threshold_shift_us": (0.0, -1.0, 1.0), "time_scale": (1.0, 0.95, 1.05)}
    now = {name: dict(zip(("value", "low", "high"), level, strict=True)) for name, level in (usual | levels).items()}
    at_utc = "2026-11-22T12:00:00.000Z"
    return {"number": number, "now": now, "at_utc": at_utc, "outcome": "followed", "distance": distance}


SINCE = "2026-11-22T11:05:00.000Z"


@pytest.mark.parametrize(
    ("levels", "words"),
    [
        ({"gain": (0.77, 0.75, 0.79)}, "In trial 2 the plateau is 23 % lower than at {}."),
        ({"gain": (1.052, 1.01, 1.09)}, "In trial 2 the plateau is 5.2 % higher than at {}."),
        ({"threshold_shift_us": (-3.0, -4.0, -2.0)}, "In trial 2 the threshold is 3.0 µs lower than at {}."),
        ({"time_scale": (1.2, 1.1, 1.3)}, "In trial 2 the muscle is 20 % slower than at {}."),
        ({}, "In trial 2 the muscle is as it was at {}."),
        ({"gain": (0.77, 0.5, 1.01)}, "By trial 2 no change since {} is certain."),
        ({"gain": (1.0, 0.94, 1.02)}, "By trial 2 no change since {} is certain."),
        ({"threshold_shift_us": (0.0, -5.1, 5.1)}, "By trial 2 no change since {} is certain."),
        ({"time_scale": (1.0, 0.89, 1.11)}, "By trial 2 no change since {} is certain."),
    ],
)
def test_only_what_the_bands_are_sure_of_is_said(levels: Any, words: str) -> None:
    (said,) = sentences([trial(), trial(2, **levels)], SINCE)
    assert said == words.format(local_time.clock(SINCE)[:5])


def test_a_trial_that_taught_the_model_nothing_changes_no_sentence() -> None:
    """What is known after it is what was expected before."""
    learnt = trial(1, gain=(0.8, 0.78, 0.82))
    for outcome in ("odd", "contradicts", "no-torque"):
        unexplained = {**trial(2, distance=None, gain=(0.7, 0.6, 0.75)), "outcome": outcome}
        assert sentences([learnt, unexplained], SINCE) == sentences([learnt], SINCE), outcome
        assert sentences([unexplained], SINCE) == []


def test_every_outcome_of_the_service_has_words() -> None:
    told = get_args(TrialOut.model_fields["outcome"].annotation)
    assert set(told) == set(OUTCOMES)
    assert len(set(OUTCOMES.values())) == len(told)


def test_the_card_tells_the_trials_without_scripts(service: Service, client: httpx.Client, approved: str):
    assert "Number of the trial" not in client.get(PAGE).text, "only where there is something"
    for _ in range(3):
        play(client)
    say(service, reason="the record is too short")
    play(client)
    page = client.get(PAGE).text
    card = page[page.index('<section class="card trials"') :]
    assert "In trial 3 the plateau is 5.9 % lower than at " in card and "as of trial 3, " in card
    assert card.count("<figure") == 3, "nobody sent a reference, so there is no error against it"
    for unit in ("94.1 ± 1.0\u00a0%", "0.5 ± 0.0\u00a0µs", "100.0 ± 1.0\u00a0%"):
        assert unit in card, unit
    assert card.count("Number of the trial") == 3
    assert "not followed" in card and "the record is too short" in card and "Start the adaptive test" not in card


def test_what_is_asked_leads_to_the_shortest_test_in_one_click(
    service: Service, pages: httpx.Client, client: httpx.Client, approved: str
) -> None:
    say(service, values={"gain": 0.7})
    play(client)
    page = pages.get(PAGE).text
    assert "The trials say that a new test is needed." in page
    notice = re.search(r'<div class="notice bad" role="alert">.*?</div>', page, re.S)
    assert notice and "After trial 1 the gain is expected to be 70.0 %" in notice[0]
    query = dict(re.findall(r'name="(\w+)" value="([^"]*)"', notice[0]))
    assert "Stops once known within" in pages.get(f"{PAGE}/start", params=query).text


def test_a_person_sets_the_limits_with_the_approval(pages: httpx.Client, client: httpx.Client, approved: str) -> None:
    client.post(f"/v1/models/{approved}/reject", json={"reason": "once more"})
    page = pages.get(f"/models/{approved}").text
    assert re.search(r'name="tracking.gain_percent"[^>]*value="20"', page)
    summary = re.search(r'<details class="more tracking"><summary>(.*?)</summary>', page, re.S)
    assert summary and "gain ±20\u00a0%, threshold ±20\u00a0% (±" in summary[1], "it is read before it is approved"
    approve = f"/v1/models/{approved}/approve"
    for wrong in (61.0, -1.0, None, "nan"):
        assert client.post(approve, json={"tracking": {"gain_percent": wrong}}).status_code == 422, wrong
    assert tracked(client).status_code == 404
    limits = {"gain_percent": 12.5, "threshold_percent": 0.0, "time_scale_percent": 60.0}
    assert client.post(approve, json={"tracking": limits}).status_code == 200
    shown = pages.get(f"/models/{approved}").text
    assert "gain ±12.5\u00a0%, threshold as approved, time scale ±60\u00a0%" in shown
    assert client.get("/v1/participants/P017/tracking").json()["limits"] == limits


@pytest.mark.browser
def test_the_card_is_renewed_while_trials_are_played(service: Service, client: httpx.Client, approved: str, tab: Any):
    # while a trial runs something else is next, and the page would be loaded anew
    tab.goto(service.url + PAGE)

    def same_line(route: Any) -> None:
        route.fulfill(json={**route.fetch().json(), "key": tab.locator("#next").get_attribute("data-next-key")})

    tab.route(f"**{PAGE}/next", same_line)
    tab.evaluate("window.same = true")
    for number in (1, 2):
        play(client)
        tab.get_by_text(f"as of trial {number},").wait_for()
    assert tab.evaluate("window.same") is True, "without reload"
    tab.get_by_text("All trials as a table").click()
    say(service, values={"gain": 0.7})
    play(client)
    asked = tab.locator("#trials .notice")
    asked.wait_for()
    tab.reload()
    tab.get_by_text("See why").wait_for()
    table = tab.locator("#trials details")
    table.locator("summary").click()
    say(service, reason="the record is too short")
    play(client)
    tab.get_by_text("the record is too short").wait_for()
    assert tab.evaluate("document.activeElement.tagName") == "SUMMARY", "who opened the table stays there"
    assert asked.get_attribute("role") is None, "the same question is read aloud once"
    tab.get_by_role("button", name="Start the adaptive test").first.click()
    tab.get_by_role("button", name="Start now").wait_for()
    assert tab.errors == []

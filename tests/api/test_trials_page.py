"""The page of a participant while a controller plays trials: what is seen, without reload, and what is asked."""

from __future__ import annotations

from typing import Any, get_args

import httpx
import pytest

from stimrig.api import local_time
from stimrig.api.models.tracking import OUTCOMES, sentences
from stimrig.api.web.responses.models import TrialOut
from tests.api.conftest import Service
from tests.api.test_tracked import play, say

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
        ({"gain": (0.77, 0.75, 0.79)}, "In trial 2 the plateau is 23.0 % lower than on {}."),
        ({"gain": (1.052, 1.01, 1.09)}, "In trial 2 the plateau is 5.2 % higher than on {}."),
        ({"threshold_shift_us": (-3.0, -4.0, -2.0)}, "In trial 2 the threshold is 3.0 µs lower than on {}."),
        ({"time_scale": (1.2, 1.1, 1.3)}, "In trial 2 the muscle is 20.0 % slower than on {}."),
        ({}, "By trial 2 no change since {} is certain."),
        ({"gain": (0.77, 0.5, 1.01)}, "By trial 2 no change since {} is certain."),
    ],
)
def test_only_what_the_bands_are_sure_of_is_said(levels: Any, words: str) -> None:
    (said,) = sentences([trial(), trial(2, **levels)], SINCE)
    assert said == words.format(local_time.when(SINCE))


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
    tab.unroute_all(behavior="ignoreErrors")
    tab.get_by_role("button", name="Start the adaptive test").first.click()
    tab.get_by_role("button", name="Start now").wait_for()
    assert tab.errors == []

"""Before current flows a person sees who, how much, how long, and presses: exactly that starts, once, and soon."""

from __future__ import annotations

import concurrent.futures
import re
from typing import Any

import httpx
import pytest

from stimrig.api.sessions.previews import CAPACITY_OF_ONE, VALID_S
from stimrig.api.store.tables import Participant
from tests.api import fake_rig
from tests.api.conftest import Service, SetClock, run_test, wait_done
from tests.api.forms import find, press
from tests.api.test_forms import tab as tab
from tests.api.test_problems import problem
from tests.api.test_profiles import calibrate

PAGE, WHERE = "/participants/P017", "/participants/P017/start"
START = "POST /v1/tests"


def rows(page: str) -> dict[str, str]:
    return dict(re.findall(r'<th scope="row">([^<]*)</th><td>(?:<b>)?([^<]*)', page))


def start(tab: httpx.Client, shown: str) -> httpx.Response:
    return press(tab, "", START, html=shown)


def test_the_page_shows_who_and_how_much_and_plays_nothing(tab: httpx.Client, client: httpx.Client, service: Service):
    client.put("/v1/participants/P017/muscle", json={"side": "right", "muscle": "triceps brachii"})
    page = tab.get(WHERE).text
    assert "Start the pre-session test of P017?" in page and "P017 is not calibrated" in page
    told = rows(page)
    assert (told["Who"], told["Current of every pulse"], told["How long"]) == ("P017", "20 mA", "25 s")
    assert told["Widest pulse"] == "300 µs, comfort maximum 300 µs" and told["Stops at"] == "30.0 N·m"
    assert re.fullmatch(r"\d+ pulses, \d\.\d\d.mC \(charge of one phase, all pulses together\)", told["Dose"])
    assert "FAKE P24" in told["Rig"] and told["Calibration"] == "not calibrated"
    assert (told["Side and muscle"], told["Run by"]) == ("right, triceps brachii", "administrator")
    assert re.search(r'class="stimulate big" data-needs-ready[^>]*>Start now: 20 mA, 300 µs<', page)
    assert service.rig.starts == 0 and service.context.runner.current is None
    calibrate(client)
    page = tab.get(WHERE).text
    assert "by administrator, valid until" in rows(page)["Calibration"] and "not calibrated" not in page


def test_start_sends_limits_that_were_typed_and_leads_on(tab: httpx.Client, client: httpx.Client) -> None:
    html = tab.get(PAGE).text
    assert re.search(rf'<button class="stimulate" data-next="{WHERE}"', html)
    assert press(tab, PAGE, f"PUT /v1{PAGE}/profile", html=html, current_ma=19.5).status_code == 200
    assert client.get("/v1" + PAGE).json()["profile"]["current_ma"] == 19.5
    assert rows(tab.get(WHERE).text)["Current of every pulse"] == "19.5 mA"


def test_it_starts_once_however_often_it_is_pressed(tab: httpx.Client, client: httpx.Client, service: Service) -> None:
    shown = tab.get(WHERE).text
    with concurrent.futures.ThreadPoolExecutor(5) as pool:
        (test_id,) = {answer.json()["id"] for answer in pool.map(lambda _: start(tab, shown), range(5))}
    assert service.rig.starts == 1
    wait_done(client, test_id)
    assert tab.get(WHERE).status_code == 200, "somebody else only looks at the same plan"
    assert start(tab, shown).json()["id"] == test_id and service.rig.starts == 1, "Back, and once more"


@pytest.mark.parametrize(("unix_s", "monotonic_s"), [(0, VALID_S + 1), (VALID_S + 1, 0), (-60, 10)])
def test_a_plan_may_be_started_for_five_minutes_by_either_clock(
    tab: httpx.Client, service: Service, unix_s: float, monotonic_s: float
) -> None:
    clock = service.context.runner.previews.clock = SetClock()
    shown = tab.get(WHERE).text
    clock.unix, clock.now_s = clock.unix + unix_s, clock.now_s + monotonic_s
    assert "Nothing was started" in problem(start(tab, shown), 410)["detail"] and service.rig.starts == 0
    clock.unix, clock.now_s = SetClock().unix + VALID_S, SetClock().now_s + VALID_S
    assert start(tab, shown).status_code == 202


def test_a_plan_is_of_one_participant_and_complete(tab: httpx.Client, client: httpx.Client, service: Service) -> None:
    client.post("/v1/participants", json={"code": "P018"})
    plan_hash = client.post("/v1/preview", json={"participant": "P017"}).json()["plan_hash"]
    asked = {"participant": "P017", "plan_hash": plan_hash}
    assert client.post("/v1/tests", json={**asked, "participant": "P018"}).status_code == 410
    assert client.post("/v1/tests", json={**asked, "plan_hash": "0" * 64}).status_code == 410
    refused = problem(client.post("/v1/tests", json={**asked, "pulse_rate_hz": 20.0}), 422)
    assert "all else is as it was previewed" in refused["detail"]
    assert tab.post("/v1/tests", json=asked).status_code == 403, "a start carries the session's CSRF token"
    assert service.rig.starts == 0
    for _ in range(CAPACITY_OF_ONE + 1):
        client.post("/v1/preview", json={"participant": "P018"})
    assert client.post("/v1/tests", json=asked).status_code == 202, "previews of others take no place of it"


@pytest.mark.parametrize(("what", "body"), [("profile", {"current_ma": 10}), ("muscle", {"side": "right"})])
def test_limits_changed_meanwhile_are_not_played(
    tab: httpx.Client, client: httpx.Client, service: Service, what: str, body: dict[str, Any]
) -> None:
    """Nor are they on a version that is read anew."""
    shown = tab.get(WHERE).text
    client.put(f"/v1/participants/P017/{what}", json=body)
    assert start(tab, shown).status_code == 412
    plan_hash = find(shown, START)[0].fields[1].value
    refused = client.post("/v1/tests", json={"participant": "P017", "plan_hash": plan_hash})
    assert "changed after the preview" in problem(refused, 409)["detail"]
    assert service.rig.starts == 0 and service.context.runner.current is None


def test_a_rig_set_up_anew_meanwhile_is_looked_at_again(
    tab: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = tab.get(WHERE).text
    widths, segments = fake_rig.default_widths()
    monkeypatch.setattr(fake_rig, "widths_of", lambda _plan: ([*widths, 300.0], segments))
    assert "would now play something else" in problem(start(tab, shown), 409)["detail"]
    assert service.rig.starts == 0 and service.context.runner.current is None


def test_a_rig_that_asks_for_a_calibration_offers_that_first(tab: httpx.Client, client: httpx.Client, service: Service):
    model = run_test(client, "P017")["model_id"]
    client.get(f"/v1/models/{model}/diagnosis")
    service.rig.require_calibration = True
    service.run(service.context.rig.fresh_status())
    page = tab.get(PAGE).text
    assert "Calibrate first" in page and "Start the pre-session test" not in page
    for query in ("", f"?kind=next-experiment&model={model}"):
        refused = tab.get(WHERE + query)
        assert refused.status_code == 409 and "Calibrate first" in refused.text
    calibrate(client)
    assert "Start the pre-session test" in tab.get(PAGE).text and "Start now" in tab.get(WHERE).text
    service.change(Participant, "P017", profile=lambda old: old | {"expires_at_utc": "2026-01-02T00:00:00Z"})
    assert "expired" in tab.get(PAGE).text and tab.get(WHERE).status_code == 409, "one of yesterday"


def test_the_next_experiment_is_shown_the_same_way(tab: httpx.Client, client: httpx.Client, service: Service):
    model = run_test(client, "P017")["model_id"]
    client.get(f"/v1/models/{model}/diagnosis")
    assert re.search(r'<button class="stimulate big"[^>]*>Run it now', tab.get(f"/models/{model}").text)
    shown = tab.get(f"{WHERE}?kind=next-experiment&model={model}").text
    assert "Start the next experiment of P017?" in shown and f'href="/models/{model}"' in shown
    assert service.rig.starts == 1
    begun = start(tab, shown).json()["id"]
    assert service.rig.starts == 2 and wait_done(client, begun)["joins"] == model


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("kind=polka", "is no test that a page starts"), ("kind=adaptive&target=99", "less than or equal to 50"),
        ("kind=next-experiment&model=M-none", "There is no model"), ("kind=adaptive&target=x", "valid number"),
    ],
)  # fmt: skip
def test_an_address_of_no_test_is_refused_in_words(tab: httpx.Client, query: str, words: str) -> None:
    answer = tab.get(f"{WHERE}?{query}")
    assert answer.status_code in (404, 422) and words in answer.text

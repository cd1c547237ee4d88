"""Before current flows a person sees who, how much, how long, and says yes: once, soon, and to exactly that."""

from __future__ import annotations

import asyncio
import concurrent.futures
import re
from typing import Any

import httpx
import pytest

from stimrig.api.people.auth import Principal
from stimrig.api.sessions.questions import LIFE_S, MOST, Question, Questions
from stimrig.api.store.tables import Participant
from stimrig.rig import messages as m
from tests.api.conftest import Service, SetClock, csrf, run_test, signed_in, wait_done
from tests.api.test_forms import fields
from tests.api.test_forms import tab as tab
from tests.api.test_profiles import calibrate

PAGE = "/participants/P017"


def ask(tab: httpx.Client) -> str:
    """Press *Start*; the address of the question."""
    asked = tab.post(f"{PAGE}/tests", data=fields(tab))
    assert asked.status_code == 303 and "/confirm/" in asked.headers["location"], asked.text
    return asked.headers["location"]


def yes(tab: httpx.Client, question: str) -> httpx.Response:
    return tab.post(question, data={"csrf": csrf(tab)})


def rows(page: str) -> dict[str, str]:
    found = re.findall(r'<th scope="row">([^<]*)</th><td>(?:<b>)?([^<]*)', page)
    return dict(found)


def status_heard(service: Service) -> m.Status:
    """The service knows what the rig says now."""
    context = service.context
    return service.run(context.rig.fresh_status())


def test_start_shows_who_and_how_much_and_plays_nothing(tab: httpx.Client, client: httpx.Client, service: Service):
    client.put("/v1/participants/P017/muscle", json={"side": "right", "muscle": "triceps brachii"})
    page = tab.get(ask(tab)).text
    assert "Start the pre-session test of P017?" in page and "P017 is not calibrated" in page
    told = rows(page)
    assert (told["Who"], told["Current of every pulse"], told["How long"]) == ("P017", "20 mA", "25 s")
    assert told["Widest pulse"] == "300 µs, comfort maximum 300 µs" and told["Stops at"] == "30.0 N·m"
    assert (
        re.fullmatch(r"\d+ pulses, \d\.\d\d.mC \(charge of one phase, all pulses together\)", told["Dose"])
        and "FAKE P24" in told["Rig"]
    )
    assert told["Calibration"] == "not calibrated"
    assert (told["Side and muscle"], told["Run by"]) == ("right, triceps brachii", "administrator")
    assert re.search(r'class="stimulate big" data-needs-ready[^>]*>Start now: 20 mA, 300 µs<', page)
    assert service.rig.starts == 0 and service.context.runner.current is None


def test_who_calibrated_and_until_when_is_told(tab: httpx.Client, client: httpx.Client) -> None:
    calibrate(client)
    page = tab.get(ask(tab)).text
    assert "by administrator, valid until" in rows(page)["Calibration"] and "not calibrated" not in page


def test_yes_starts_once_however_often_it_is_said(tab: httpx.Client, client: httpx.Client, service: Service) -> None:
    question = ask(tab)
    form = {"csrf": csrf(tab)}
    with concurrent.futures.ThreadPoolExecutor(5) as pool:
        answers = list(pool.map(lambda _: tab.post(question, data=form), range(5)))
    addresses = {answer.headers["location"] for answer in answers}
    (address,) = addresses
    assert address.startswith("/tests/T") and service.rig.starts == 1
    assert tab.get(question).headers["location"] == address, "Back leads to the test"
    wait_done(client, address.split("/")[-1])
    assert yes(tab, question).headers["location"] == address, "Back, and once more yes"
    assert service.rig.starts == 1


@pytest.mark.parametrize(("unix_s", "monotonic_s"), [(0, LIFE_S + 1), (LIFE_S + 1, 0), (-60, 10)])
def test_a_question_is_open_for_five_minutes_by_either_clock(
    tab: httpx.Client, service: Service, unix_s: float, monotonic_s: float
) -> None:
    clock = service.context.questions.clock = SetClock()
    question = ask(tab)
    clock.unix, clock.now_s = clock.unix + unix_s, clock.now_s + monotonic_s
    for answer in (tab.get(question), yes(tab, question)):
        assert (
            answer.status_code == 410 and "Nothing was done" in answer.text and "Back to the participant" in answer.text
        )
    assert service.rig.starts == 0
    clock.unix, clock.now_s = SetClock().unix + LIFE_S, SetClock().now_s + LIFE_S
    assert tab.get(question).status_code == 200


def test_a_question_belongs_to_whom_it_was_asked(tab: httpx.Client, client: httpx.Client, service: Service) -> None:
    question = ask(tab)
    client.post("/v1/participants", json={"code": "P018"})
    with signed_in(service) as other:
        assert yes(other, question).status_code == 410
    assert yes(tab, question.replace("P017", "P018")).status_code == 410
    assert tab.post(question).status_code == 403, "a yes carries the session's CSRF token"
    assert yes(tab, f"{PAGE}/confirm/made-up").status_code == 410
    assert service.rig.starts == 0


@pytest.mark.parametrize(("what", "body"), [("profile", {"current_ma": 10}), ("muscle", {"side": "right"})])
def test_limits_changed_meanwhile_are_not_played(
    tab: httpx.Client, client: httpx.Client, service: Service, what: str, body: dict[str, Any]
) -> None:
    question = ask(tab)
    client.put(f"/v1/participants/P017/{what}", json=body)
    refused = yes(tab, question)
    assert refused.status_code == 412 and f"set {what}" in refused.text
    assert service.rig.starts == 0 and service.context.runner.current is None


def test_a_rig_set_up_anew_meanwhile_is_asked_about_again(
    tab: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    question = ask(tab)
    widths, segments = service.rig._widths(m.TestPlan(test_id="T", participant="P", profile=m.Profile()))
    monkeypatch.setattr(service.rig, "_widths", lambda _plan: ([*widths, 300.0], segments))
    refused = yes(tab, question)
    assert refused.status_code == 409 and "would now play something else" in refused.text
    assert service.rig.starts == 0 and service.context.runner.current is None


def test_a_rig_that_asks_for_a_calibration_offers_that_first(tab: httpx.Client, client: httpx.Client, service: Service):
    model = run_test(client, "P017")["model_id"]
    client.get(f"/v1/models/{model}/diagnosis")
    starts = service.rig.starts
    service.rig.require_calibration = True
    assert status_heard(service).require_calibration
    page = tab.get(PAGE).text
    assert "Calibrate first" in page and "Start the pre-session test" not in page
    for path in (f"{PAGE}/tests", f"/models/{model}/experiment"):
        seen = client.get("/v1/participants/P017").headers["etag"].strip('"')
        refused = tab.post(path, data={"csrf": csrf(tab), "seen": seen})
        assert refused.status_code == 409 and "Calibrate first" in refused.text
    assert service.rig.starts == starts
    calibrate(client)
    assert "Start the pre-session test" in tab.get(PAGE).text and "Start now" in tab.get(ask(tab)).text


def test_a_calibration_of_yesterday_starts_nothing(tab: httpx.Client, client: httpx.Client, service: Service) -> None:
    calibrate(client)
    service.change(Participant, "P017", profile=lambda old: old | {"expires_at_utc": "2026-01-02T00:00:00Z"})
    assert "Calibrate first" in tab.get(PAGE).text and "expired" in tab.get(PAGE).text
    assert tab.post(f"{PAGE}/tests", data=fields(tab)).status_code == 409


def test_the_next_experiment_is_asked_about_the_same_way(tab: httpx.Client, client: httpx.Client, service: Service):
    model = run_test(client, "P017")["model_id"]
    client.get(f"/v1/models/{model}/diagnosis")
    page = tab.get(f"/models/{model}").text
    assert re.search(r'<button class="stimulate big"[^>]*>Run it now', page)
    asked = tab.post(f"/models/{model}/experiment", data={"csrf": csrf(tab)})
    text = tab.get(asked.headers["location"]).text
    assert "Start the next experiment of P017?" in text and f'href="/models/{model}#experiment"' in text
    assert service.rig.starts == 1
    address = yes(tab, asked.headers["location"]).headers["location"]
    assert service.rig.starts == 2
    assert wait_done(client, address.split("/")[-1])["joins"] == model


def test_a_busy_rig_asks_nobody(tab: httpx.Client, client: httpx.Client, service: Service) -> None:
    service.rig.speed = 0.2  # runs until it is stopped below
    form = fields(tab)
    question = ask(tab)
    test_id = client.post("/v1/tests", json={"participant": "P017"}).json()["id"]
    for answer in (tab.post(f"{PAGE}/tests", data=form), yes(tab, question)):
        assert answer.status_code == 409 and f"/tests/{test_id}" in answer.text
    assert service.rig.starts == 1
    assert client.post("/v1/stop").status_code == 200
    assert wait_done(client, test_id)["state"] == "stopped"


def test_many_questions_of_one_drop_no_one_elses() -> None:
    questions = Questions(SetClock())
    ada, ben = (Principal(name, frozenset(), csrf=name) for name in ("Ada", "Ben"))

    async def action() -> str:
        return "/done"

    def of(who: Principal) -> str:
        address = questions.ask(Question("P1", "Yes?", "Yes", action), who)
        return address.split("/")[-1]

    first, own = of(ben), [of(ada) for _ in range(3 * MOST)]
    assert questions.find("P1", first, ben).title == "Yes?"
    assert questions.find("P1", own[-MOST], ada) and len(questions._all) == MOST + 1
    with pytest.raises(Exception, match="question is closed"):
        questions.find("P1", own[-MOST - 1], ada)


def test_a_deed_that_failed_is_not_done_again() -> None:
    questions, done = Questions(SetClock()), []
    who = Principal("Ada", frozenset(), csrf="x")

    async def action() -> str:
        done.append(1)
        raise RuntimeError("no")

    async def twice() -> list[Any]:
        number = questions.ask(Question("P1", "Yes?", "Yes", action), who).split("/")[-1]
        question = questions.find("P1", number, who)
        return await asyncio.gather(questions.yes(question), questions.yes(question), return_exceptions=True)

    assert [str(error) for error in asyncio.run(twice())] == ["no", "no"] and done == [1]

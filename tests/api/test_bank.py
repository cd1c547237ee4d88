"""An adaptive test that starts from earlier models: which ones, by what names, and who is told of them."""

from __future__ import annotations

import json
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed

from stimrig.api.sessions.requests import TestIn
from stimrig.api.store.tables import Participant, Test
from stimrig.rig.messages import Profile, TestPlan
from tests.api.conftest import QUICK_SPEED, Service, csrf, own_service, run_test, signed_in, wait_done
from tests.api.test_controller_keys import made
from tests.api.test_forms import fields

service = own_service(speed=QUICK_SPEED)
LEFT = {"side": "left", "muscle": "biceps"}
ASKED = {"participant": "P017", "kind": "adaptive", "bank": True}


def approved(client: httpx.Client, code: str, **site: str) -> dict[str, Any]:
    """Somebody with a test whose model is approved."""
    client.post("/v1/participants", json={"code": code, **site})
    document = run_test(client, code)
    assert client.post(f"{document['model_url']}/approve", json={}).status_code == 200
    return document


def usable(client: httpx.Client) -> int | None:
    """How many earlier models a test of P017 starts from."""
    return client.post("/v1/preview", json=ASKED).json()["reach"]["bank"]


def names(service: Service, code: str = "P017") -> list[str]:
    plan = TestPlan(
        test_id="T1",
        participant=code,
        segments=None,
        profile=Profile(current_ma=20.0, max_pulse_width_us=300.0, max_torque_nm=30.0),
    )
    return [name for name, _text in service.context.runner.adaptive._known(plan, with_bank=True)["bank"]]


@pytest.fixture
def somebody(client: httpx.Client) -> str:
    assert client.post("/v1/participants", json={"code": "P017", **LEFT}).status_code == 201
    return "P017"


def test_candidates_are_own_models_and_the_latest_of_others_at_the_same_muscle(
    client: httpx.Client, service: Service, somebody: str
) -> None:
    assert usable(client) == 0, "no model yet"
    own = approved(client, somebody)
    day = service.context.clock.utc()[:10]
    assert names(service) == [f"own model 1 of {day}"]
    approved(client, "P018", **LEFT)
    approved(client, "P018", **LEFT)
    approved(client, "P019", side="right", muscle="biceps")
    approved(client, "P020", side="left", muscle="triceps")
    approved(client, "P021")  # nobody has said which muscle
    everybody = [f"own model 1 of {day}", "another person 1", "another person 2"]
    assert names(service) == everybody and usable(client) == 3
    approved(client, somebody)
    assert names(service)[:2] == [f"own model 1 of {day}", f"own model 2 of {day}"] and usable(client) == 4
    assert client.post(f"{own['model_url']}/reject", json={"reason": "slipped"}).status_code == 200
    assert client.post("/v1/participants/P021/archive").status_code == 200
    assert names(service) == everybody[:2]
    assert client.post("/v1/preview", json={**ASKED, "bank": False}).json()["reach"]["bank"] is None


def test_nobody_is_told_who_the_others_are(client: httpx.Client, service: Service, somebody: str) -> None:
    """A controller's key is of one participant; what it reads of a test with a bank names nobody else."""
    approved(client, somebody)
    approved(client, "P018", **LEFT)
    service.rig.speed = 1.0
    started = client.post("/v1/tests", json={**ASKED, "target": {"curve_percent": 1.0}})
    assert started.status_code == 202, started.text
    test_id = started.json()["id"]
    key = made(client, somebody)
    told = []
    with service.live(test_id, key) as socket:
        try:
            while True:
                told.append(socket.recv(timeout=30.0))
        except ConnectionClosed:
            pass
    live = [message for message in map(json.loads, told) if message["type"] == "adaptive"]
    assert live[-1]["bank"]["another person 1"] > 0 and "Like own model 1 of" in live[-1]["words"]
    document = wait_done(client, test_id)
    assert document["adaptive"]["ended"] == "known-enough" and document["adaptive"]["reach"]["bank"] == 2
    assert sorted(document["adaptive"]["bank"]) == sorted([*names(service), "unlike all"])
    with service.client(key) as bound:
        read = bound.get(f"/v1/tests/{test_id}")
        assert read.status_code == 200 and "another person 1" in read.text
    with service.context.store.read() as session:
        kept = json.dumps(session.get(Test, test_id).as_dict())
    for text in (read.text, kept, *told):
        assert "P018" not in text


def test_a_bank_that_is_too_large_leaves_the_oldest_out(
    client: httpx.Client, service: Service, somebody: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stimrig.api.sessions.adaptive.MOST_IN_BANK", 2)
    approved(client, "P018", **LEFT)
    approved(client, "P019", **LEFT)
    newest = approved(client, "P020", **LEFT)
    person = service.context.store.get(Participant, somebody)
    found = service.context.versions.last_of_others(person, 2)
    assert [row.participant for row in found] == ["P020", "P019"] and found[0].id == newest["model_id"]
    assert names(service) == ["another person 1", "another person 2"]


def test_it_is_off_where_nobody_asks_for_it() -> None:
    assert TestIn(participant="P017", kind="adaptive").bank is False
    assert TestIn(participant="P017", bank=False).kind == "pre-session", "a client may send every default"


def test_the_pages_choice_is_asked_about_and_says_what_there_is(
    client: httpx.Client, service: Service, somebody: str
) -> None:
    with signed_in(service) as browser:

        def asked(**more: str) -> tuple[str, str]:
            form = {**fields(browser, "/participants/P017"), "plan": "adaptive", "target": "2"}
            assert "bank" not in form, "not ticked"
            place = browser.post("/participants/P017/tests", data={**form, **more}).headers["location"]
            return place, browser.get(place).text

        assert "Earlier models" not in asked()[1]
        assert "<td><b>none that can be used: a test as ever</b>" in asked(bank="1")[1]
        approved(client, somebody)
        place, question = asked(bank="1")
        assert "Earlier models</th><td><b>1</b>" in question
        service.rig.speed = 1.0
        test_id = browser.post(place, data={"csrf": csrf(browser)}).headers["location"].rpartition("/")[2]
        assert wait_done(client, test_id)["adaptive"]["ended"] == "known-enough"
        page = browser.get(f"/tests/{test_id}", headers={"Accept-Language": "de"}).text
        assert "Wie das eigene Modell 1 vom" in page and "Last decision" not in page

"""A controller's key: one participant, one day, one plan. Every route is tried with it, and every way around it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed

from stimrig.api.store.audit import digest
from stimrig.api.store.tables import AuditEntry, Test, Token
from stimrig.api.web.guards import OPEN
from tests.api.browser import without_values
from tests.api.conftest import HTML, TOKEN, Service, play_test, run_test, shared_service, wait_done
from tests.api.test_scopes import ROWS

PLAN = {"name": "ilc", "current_ma": 15, "max_pulse_width_us": 200, "max_duration_s": 60, "trials": 3}
SEGMENTS = [{"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": [0, 100, 150] * 20}}]
TRIAL = {"participant": "P1", "kind": "sequence", "segments": SEGMENTS}
MODEL = "/v1/participants/P1/model"
SCOPES = ("approve-model", "run-test", "read-live", "read-model")
FREE = {f"{row[0]} {row[1]}" for row in ROWS if row[2] == "anybody" and row[3] != "401"}
"""What nobody needs to be anybody for: a key gets there what a stranger gets."""
ANSWERS = {("POST", "/v1/stop"): 200, ("GET", "/v1/sequences"): 200, ("POST", "/v1/sessions"): 401,
           ("POST", "/v1/tests"): 428}  # fmt: skip
"""Of open routes without a body: which participant is meant is not known yet."""
shared = shared_service()


@pytest.fixture(scope="module")
def admin(shared: Service) -> Iterator[httpx.Client]:
    with shared.client() as client:
        yield client


@pytest.fixture(scope="module")
def done(admin: httpx.Client) -> dict[str, dict[str, Any]]:
    """A test with an approved model of each participant."""
    tests = {code: play_test(admin, code) for code in ("P1", "P2")}
    for test in tests.values():
        assert admin.post(f"/v1/models/{test['model_id']}/approve", json={}).status_code == 200
    return tests


@pytest.fixture(autouse=True)
def ready(shared: Service, admin: httpx.Client, done: dict[str, Any]) -> None:
    """Whatever the test before has stopped."""
    if shared.rig.state != "ready":
        assert admin.post("/v1/rearm").status_code == 200


def made(maker: httpx.Client, code: str = "P1", **changed: Any) -> str:
    """A key's text."""
    answer = maker.post(f"/v1/participants/{code}/keys", json={**PLAN, **changed})
    assert answer.status_code == 201, answer.text
    return answer.json()["key"]


@pytest.fixture
def key(shared: Service, admin: httpx.Client) -> Iterator[httpx.Client]:
    with shared.client(made(admin)) as client:
        yield client


@pytest.fixture(scope="module")
def one_key(admin: httpx.Client, done: dict[str, Any]) -> str:
    return made(admin)


def refused(answer: httpx.Response, code: str = "outside-key") -> str:
    assert answer.status_code == 403, (answer.request.url, answer.status_code, answer.text[:300])
    assert answer.json()["type"] == f"/problems/{code}"
    return answer.json()["detail"]


def test_every_route_that_is_not_opened_is_closed(shared: Service, one_key: str) -> None:
    """With x for whatever a path names: what is not there is refused as what is another's."""
    with shared.client(one_key) as key, shared.client(token=None) as stranger:
        for method, path, *_ in ROWS:
            answer, asked = key.request(method, path), f"{method} {path}"
            if asked in FREE:
                assert answer.status_code == stranger.request(method, path).status_code, asked
                continue
            assert answer.status_code == ANSWERS.get((method, path), 403), (asked, answer.text)
            if path == "/v1/stop":
                assert "rig" not in answer.json()
            if answer.status_code == 403:
                assert "P1" in answer.text and "not among them" in answer.text, asked


def test_it_opens_what_is_its_participants(key: httpx.Client, done: dict[str, dict[str, Any]]) -> None:
    test = done["P1"]
    model = key.get(MODEL)
    assert model.status_code == 200
    assert key.get(MODEL, headers={"If-None-Match": model.headers["etag"]}).status_code == 304
    ask = f"/v1/models/{test['model_id']}"
    assert key.post(f"{ask}/prediction", json={"pulse_width_us": [0, 100]}).status_code == 200
    assert key.post(f"{ask}/widths", json={"reference_torque_nm": [0, 1]}).status_code == 200
    assert key.get(f"/v1/tests/{test['id']}").json()["participant"] == "P1"
    assert key.get(f"/v1/recordings/{test['recording_id']}").content.startswith(b"\x89HDF")
    assert key.get(f"/v1/recordings/{test['recording_id']}/csv").status_code == 200
    assert key.get("/v1/sequences").json()["sequences"]
    assert len(OPEN) == 9, "what is opened further is tried here"


def test_what_is_anothers_is_refused_as_what_is_not_there(
    shared: Service, key: httpx.Client, done: dict[str, dict[str, Any]]
) -> None:
    other = done["P2"]
    tried = {
        "/v1/participants/{}/model": "P2",
        "/v1/tests/{}": other["id"],
        "/v1/recordings/{}": other["recording_id"],
        "/v1/recordings/{}/csv": other["recording_id"],
    }
    for path, there in tried.items():
        assert refused(key.get(path.format(there))) == refused(key.get(path.format("nothing")))
    for path, body in (("prediction", {"pulse_width_us": [0]}), ("widths", {"reference_torque_nm": [0]})):
        answers = [key.post(f"/v1/models/{model}/{path}", json=body) for model in (other["model_id"], "nothing")]
        assert refused(answers[0]) == refused(answers[1])
    head = {"If-Match": key.get(MODEL).headers["etag"]}
    answers = [key.post("/v1/tests", json={**TRIAL, "participant": code}, headers=head) for code in ("P2", "P99")]
    assert refused(answers[0]) == refused(answers[1]) and "P2" not in answers[0].text
    for test_id in (other["id"], "nothing"):
        with shared.live(test_id, None, Authorization=key.headers["authorization"]) as socket:
            assert json.loads(socket.recv())["problem"]["type"] == "/problems/outside-key"
            with pytest.raises(ConnectionClosed):
                socket.recv()


# ---- what it is told of another participant -----------------------------------------------------------------------


def test_a_busy_rig_tells_nothing_of_another_participant(shared: Service, key: httpx.Client, admin: httpx.Client):
    shared.rig.speed = 1.0
    begun = admin.post("/v1/tests", json={"participant": "P2"})
    try:
        answer = key.post("/v1/tests", json=TRIAL)
        assert answer.status_code == 409 and "P2" not in answer.text and "holder" not in answer.json()
        stopped = key.post("/v1/stop")
        assert stopped.status_code == 200 and "P2" not in stopped.text
    finally:
        shared.rig.speed = 12.0
    wait_done(admin, begun.json()["id"])


def test_a_stopped_rig_tells_nothing_of_another_participant(shared: Service, key: httpx.Client, admin: httpx.Client):
    """After a crash the rig's reason names the test that ran."""
    admin.post("/v1/stop")
    shared.rig.reason = "the rig died during a test (test T1 of participant P2)"
    assert "P2" in admin.post("/v1/tests", json=TRIAL).text
    answer = key.post("/v1/tests", json=TRIAL)
    assert answer.json()["type"] == "/problems/rig-latched" and "re-arms it" in answer.json()["detail"]
    assert "P2" not in answer.text


def test_its_live_channel_tells_nothing_of_another_participants_test(
    shared: Service, key: httpx.Client, admin: httpx.Client, done: dict[str, Any]
) -> None:
    """While its own test is identified, the rig may play another one."""
    hub, own = shared.context.runner.hub, done["P1"]["id"]
    shared.change(Test, own, state="identifying")
    said: list[str] = []
    try:
        with shared.live(own, None, Authorization=key.headers["authorization"]) as socket:
            assert json.loads(socket.recv())["type"] == "test"
            other = run_test(admin, "P2")
            hub.send({"type": "state", "rig": {"test_id": own, "state": "sealing"}})
            hub.send({"type": "link", "connected": True})
            while not said or json.loads(said[-1])["type"] != "link":
                said.append(str(socket.recv()))
    finally:
        shared.change(Test, own, state="completed")
    assert not [message for message in said if "P2" in message or other["id"] in message]
    kinds = [json.loads(message)["type"] for message in said]
    assert [kind for kind in kinds if kind != "idle"] == ["state", "link"], "idle comes where a while brought nothing"


# ---- its plan -------------------------------------------------------------------------------------------------------


def test_a_trial_is_played_with_the_plans_limits_and_watched(shared: Service, key: httpx.Client) -> None:
    begun = key.post("/v1/tests", json=TRIAL)
    assert begun.status_code == 202, begun.text
    with shared.live(begun.json()["id"], None, Authorization=key.headers["authorization"]) as socket:
        assert {json.loads(message)["type"] for message in socket} >= {"history", "test"}
    test = wait_done(key, begun.json()["id"])
    assert test["state"] == "completed" and key.get(f"/v1/recordings/{test['recording_id']}").status_code == 200
    row = shared.context.store.get(Test, test["id"])
    assert row.plan["profile"]["current_ma"] == 15.0 and row.plan["max_pulse_width_us"] == 200.0
    assert row.requested_by.startswith("ilc (")


@pytest.mark.parametrize(
    ("plan", "changed", "words"),
    [
        ({}, {"kind": "pre-session"}, "kind"),
        ({}, {"kind": "adaptive", "segments": None}, "kind"),
        ({}, {"segments": None}, "segments"),
        ({}, {"segments": None, "protocol": "paper"}, "segments"),
        ({}, {"profile": {"current_ma": 16.0}}, "current_ma 16 mA is above the plan's 15 mA"),
        ({}, {"profile": {"max_pulse_width_us": 201.0}}, "max_pulse_width_us 201 µs is above the plan's 200 µs"),
        ({}, {"pulse_rate_hz": 60.0}, "pulse_rate_hz 60 is not the approved model's 40"),
        ({}, {"pulse_rate_hz": 39.9}, "pulse_rate_hz 39.9 is not the approved model's 40"),
        ({}, {"joins": "none"}, "joins"),
        ({}, {"ran_by": "Somebody Else"}, "ran_by"),
        ({"max_duration_s": 0.5}, {}, "longer than the plan's 0.5 s"),
        ({"max_pulse_width_us": 120}, {}, "150 µs is above the plan's 120 µs"),
    ],
)
def test_what_is_beyond_the_plan_is_refused_in_one_line(
    shared: Service, admin: httpx.Client, plan: dict[str, Any], changed: dict[str, Any], words: str
) -> None:
    before = shared.rig.starts
    with shared.client(made(admin, **plan)) as key:
        detail = refused(key.post("/v1/tests", json={**TRIAL, **changed}), "beyond-plan")
    assert words in detail and "\n" not in detail and detail.endswith(".") and shared.rig.starts == before


def test_limits_that_were_narrowed_after_the_key_was_made_hold(
    shared: Service, key: httpx.Client, admin: httpx.Client
) -> None:
    before = admin.get("/v1/participants/P1").json()["profile"]
    admin.put("/v1/participants/P1/profile", json={"current_ma": 9.0})
    test = wait_done(key, key.post("/v1/tests", json=TRIAL).json()["id"])
    admin.put("/v1/participants/P1/profile", json={"current_ma": before["current_ma"]})
    assert shared.context.store.get(Test, test["id"]).plan["profile"]["current_ma"] == 9.0


def test_one_whose_trials_are_used_up_plays_none_and_still_stops(shared: Service, admin: httpx.Client) -> None:
    """A program makes it, by the scopes that it passes on."""
    with shared.client(shared.token("a program", *SCOPES)) as program:
        text = made(program, trials=1)
    with shared.client(text) as key:
        wait_done(key, key.post("/v1/tests", json=TRIAL).json()["id"])
        assert "are played: 1." in refused(key.post("/v1/tests", json=TRIAL), "beyond-plan")
        assert key.post("/v1/stop").status_code == 200


def test_after_a_rejection_it_plays_nothing_and_plans_nothing(
    shared: Service, key: httpx.Client, admin: httpx.Client, done: dict[str, Any]
) -> None:
    model, before = done["P1"]["model_id"], shared.rig.starts
    approval = shared.context.versions.approved("P1")
    asked = {"widths": {"reference_torque_nm": [0, 1]}, "prediction": {"pulse_width_us": [0, 100]}}
    head = {"If-Match": key.get(MODEL).headers["etag"]}
    assert admin.post(f"/v1/models/{model}/reject", json={"reason": "wrong"}).status_code == 200
    try:
        answers = [key.post(f"/v1/models/{model}/{path}", json=body) for path, body in asked.items()]
        for answer in [key.post("/v1/tests", json=TRIAL, headers=head), *answers]:
            assert answer.status_code == 409 and answer.json()["type"] == "/problems/no-approved-model"
        assert shared.rig.starts == before and key.post("/v1/stop").status_code == 200
    finally:
        assert admin.post(f"/v1/models/{model}/approve", json={}).status_code == 200
    admin.post("/v1/rearm")
    other = run_test(admin, "P1")
    for path, body in asked.items():
        for version in (other["model_id"], f"{model}.{approval.id}.1", f"{model}.99.0"):
            assert "approved model" in refused(key.post(f"/v1/models/{version}/{path}", json=body))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"current_ma": 21}, "above the limit of today"),
        ({"max_pulse_width_us": 301}, "above the limit of today"),
        ({"trials": 0}, "trials"),
        ({"trials": 201}, "trials"),
        ({"max_duration_s": 301}, "max_duration_s"),
        ({"current_ma": "1e1"}, "current_ma"),
        ({"name": "<b>"}, "name"),
    ],
)
def test_a_plan_is_never_wider_than_the_participants_limits(admin: httpx.Client, changed: dict[str, Any], words: str):
    answer = admin.post("/v1/participants/P1/keys", json={**PLAN, **changed})
    assert answer.status_code == 422 and words in answer.text


# ---- its maker, and its end -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("lacking", ["run-test", "read-live", "read-model"])
def test_a_key_gives_no_scope_that_its_maker_lacks(shared: Service, admin: httpx.Client, lacking: str) -> None:
    with shared.client(shared.token(f"lacks {lacking}", *{*SCOPES} - {lacking})) as clinician:
        version = admin.get("/v1/participants/P1").headers["etag"]
        answer = clinician.post("/v1/participants/P1/keys", json=PLAN, headers={"If-Match": version})
        assert answer.status_code == 403 and lacking in answer.text and "stimrig_" not in answer.text
        assert "Make the key" not in clinician.get("/participants/P1", headers=HTML).text


Ending = Callable[[Service, httpx.Client, str, str], object]
"""Ends a key: of the service, the administrator, the key's text and its maker's."""


def past(service: Service, _admin: httpx.Client, key: str, _maker: str) -> None:
    row = service.context.store.get(Token, digest(key))
    assert row.expires_utc == service.context.clock.end_of_day_utc() and row.participant == "P1"
    service.change(Token, digest(key), expires_utc=service.context.clock.utc())


def revoked(_service: Service, admin: httpx.Client, key: str, _maker: str) -> None:
    address = f"/v1/participants/P1/keys/{digest(key)[:16]}"
    assert admin.delete(address.replace("P1", "P2")).status_code == 404
    assert admin.delete(address).status_code == 204


def maker_past(service: Service, _admin: httpx.Client, _key: str, maker: str) -> None:
    service.change(Token, digest(maker), expires_utc=service.context.clock.utc())


def maker_revoked(_service: Service, admin: httpx.Client, _key: str, maker: str) -> None:
    assert admin.delete(f"/v1/tokens/{digest(maker)[:16]}").status_code == 204


@pytest.mark.parametrize(
    ("end", "words"),
    [(past, "expired"), (revoked, "revoked"), (maker_past, "Who made this key"), (maker_revoked, "Who made this key")],
)
def test_it_opens_nothing_after_its_end_and_still_stops(
    shared: Service, admin: httpx.Client, end: Ending, words: str
) -> None:
    maker = shared.token(f"maker {end.__name__}", *SCOPES)
    with shared.client(maker) as program:
        text = made(program)
    with shared.client(text) as key:
        assert key.get(MODEL).status_code == 200
        end(shared, admin, text, maker)
        for answer in (key.get(MODEL), key.post("/v1/tests", json=TRIAL)):
            assert answer.status_code == 401 and words in answer.text
        assert key.post("/v1/stop").status_code == 200
    page = admin.get("/participants/P1", headers=HTML).text
    assert ("expired" if end is past else "revoked") in page and text not in page


def test_it_falls_with_a_person_who_is_removed(shared: Service, admin: httpx.Client) -> None:
    secret = "a long passphrase"
    assert admin.post("/v1/users", json={"name": "Ada", "password": secret, "scopes": SCOPES}).status_code == 201
    with shared.client(token=None) as browser:
        csrf = browser.post("/v1/sessions", json={"name": "Ada", "password": secret}).json()["csrf"]
        browser.headers["X-CSRF-Token"] = csrf
        assert browser.post("/v1/participants/P1/keys", json=PLAN).status_code == 403, "the password once more"
        assert browser.post("/v1/sessions/confirm", json={"password": secret}).status_code == 204
        text = made(browser)
    with shared.client(text) as key:
        assert key.get(MODEL).status_code == 200
        assert admin.delete("/v1/users/Ada").status_code == 204
        assert key.get(MODEL).status_code == 401


def test_it_signs_nobody_in_on_the_page(shared: Service, one_key: str) -> None:
    with shared.client(token=None) as browser:
        answer = browser.post("/v1/sessions", data={"token": one_key})
        assert answer.status_code == 403 and "set-cookie" not in answer.headers
        home = browser.get("/", headers={"Authorization": f"Bearer {one_key}"})
        assert "P2" not in without_values(home.text) and "sign-in" in home.text


def test_it_is_in_the_trail_and_its_text_is_not(shared: Service, admin: httpx.Client) -> None:
    text = made(admin, name="audited")
    entries = shared.context.store.all(AuditEntry, order=AuditEntry.seq)
    (entry,) = [one for one in entries if one.subject.startswith("audited (")]
    assert entry.action == "issue token" and entry.detail["participant"] == "P1" and entry.detail["plan"]["trials"] == 3
    assert entry.detail["until"] and text not in json.dumps(entry.detail)
    assert text not in admin.get("/v1/tokens").text and TOKEN not in admin.get("/v1/tokens").text

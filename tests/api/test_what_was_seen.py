"""What a stranger found of decisions on what was not seen: each stays mended."""

from __future__ import annotations

import asyncio
import re
import socket
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import Mock

import httpx
import pytest

from stimrig.api.client.errors import Conflict
from stimrig.api.client.rest import Client
from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.people.auth import Scope
from stimrig.api.store import audit
from stimrig.api.store.tables import Token
from stimrig.api.web import guards
from stimrig.rig import messages as m
from stimrig.rig.requests import WithdrawRequest
from tests.api.conftest import HTML, TOKEN, Service, csrf, run_test, signed_in, soon
from tests.api.fake_arm import still
from tests.api.test_forms import fields, inputs
from tests.api.test_overtaken import TRIAL, key_of
from tests.api.test_profiles import mark_all

QUIET: Any = None
"""A client that says no version by itself."""
HOME = "/v1/participants/P017"
PAGE = "/participants/P017"


def playing(service: Service, client: httpx.Client, code: str, maker: httpx.Client | None = None) -> str:
    """A controller's trial plays; the public id of its key."""
    key, controller = key_of(service, client, code, maker)
    service.rig.speed = 0.2
    assert controller.post("/v1/tests", json={"participant": code, **TRIAL}).status_code == 202
    return key


def test_a_trial_ends_with_the_right_of_who_made_its_key(
    service: Service, client: httpx.Client, participant: str, approved: str
) -> None:
    maker = service.client(service.token("clin", "approve-model", "run-test", "read-live", "read-model"))
    playing(service, client, participant, maker)
    of_maker = next(token["id"] for token in client.get("/v1/tokens").json() if token["name"] == "clin")
    assert client.delete(f"/v1/tokens/{of_maker}").status_code == 204
    assert [request.begun for request in service.rig.withdrawn] == [True] and approved


def test_a_withdrawal_that_the_rig_does_not_take_is_repeated_and_stops_meanwhile(
    service: Service, client: httpx.Client, participant: str, approved: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = playing(service, client, participant)
    rig, failed = service.context.rig, list[int]()
    ask = rig.ask

    async def fails_once(message: Any, timeout_s: float | None = None) -> Any:
        if isinstance(message, WithdrawRequest) and not failed:
            failed.append(1)
            raise ApiError(503, "rig-unreachable", "The rig cannot be reached")
        return await ask(message, timeout_s)

    monkeypatch.setattr(rig, "ask", fails_once)
    assert client.post(f"{PAGE}/keys/{key}/revoke").status_code == 303
    soon(lambda: service.rig.stopped_by == "service")
    assert approved and failed


@pytest.mark.parametrize("same_text", [True, False])
def test_a_token_that_came_back_starts_tests(service: Service, client: httpx.Client, participant: str, same_text: bool):
    """Its revocation stays in the trail, newer than what was read of the participant."""
    text, auth = service.token("lab", "run-test", "read-live"), service.context.auth
    (known,) = [row for row in service.context.store.all(Token) if row.name == "lab"]
    assert auth.revoke(known.hash[:16], "somebody")
    again = auth.issue("lab", [Scope.RUN_TEST, Scope.READ_LIVE], "somebody", text=text if same_text else None)
    assert service.client(again).post("/v1/tests", json={"participant": participant}).status_code == 202


def test_a_form_that_comes_back_for_want_of_something_is_as_old_as_it_was(
    pages: httpx.Client, client: httpx.Client, participant: str
) -> None:
    form = {**fields(pages), "csrf": csrf(pages)}
    client.put(f"{HOME}/profile", json={"max_torque_nm": 12})
    back = pages.post(f"{PAGE}/profile", data={**form, "current_ma": "x"})
    assert back.status_code == 422
    (kept,) = set(re.findall(r'name="seen" value="([^"]+)"', back.text))
    assert kept == form["seen"]
    assert pages.post(f"{PAGE}/profile", data={**form, "seen": kept, "current_ma": "19"}).status_code == 409


def test_a_question_ends_with_its_day(service: Service, client: httpx.Client, participant: str) -> None:
    with signed_in(service) as tab:
        asked = tab.post(f"{PAGE}/tests", data=fields(tab))
        questions = service.context.questions
        (question,) = questions._all.values()
        question.seen = replace(question.seen, day="2020-01-01")
        answer = tab.post(asked.headers["location"], data={"csrf": csrf(tab)})
        assert answer.status_code == 409 and "2020-01-01" in answer.text
    assert service.rig.starts == 0


def test_a_page_of_another_day_offers_nothing(pages: httpx.Client, client: httpx.Client, participant: str) -> None:
    form = {**fields(pages), "csrf": csrf(pages), "current_ma": "19"}
    form["seen"] = re.sub(r"\.\d{4}-", ".2020-", form["seen"])
    refused = pages.post(f"{PAGE}/profile", data=form)
    assert refused.status_code == 409 and "This page is of 2020-" in refused.text
    assert "all the same" not in refused.text


def test_a_waiting_result_is_let_go_by_who_saw_it(service: Service, client: httpx.Client, participant: str) -> None:
    at = f"{HOME}/calibration"
    client.post(at, json={})
    mark_all(client)
    found = client.get(at).json()
    service.rig.calibrated = finished(service)
    missing = client.get(at)
    assert missing.status_code == 404 and missing.headers["etag"] == f'"{found["calibration_id"]}.0"'
    for tag, status in (('"C20200101T000000-000000-1.3"', 409), (missing.headers["etag"], 200)):
        sent = client.post(f"{at}/discard", headers={"If-Match": tag})
        assert sent.status_code == status, sent.text
        assert (status == 409) == ("has begun another calibration since this page" in sent.text)
    assert service.rig.calibrated is None


def finished(service: Service) -> Any:
    """As if the service had not heard the rig's answer."""
    open_one = service.rig.calibration
    assert open_one is not None
    service.rig.calibration, service.rig.state = None, "ready"
    return m.Calibrated(
        calibration_id=open_one.calibration_id, participant=open_one.participant, by="x", result=m.CalibrationResult()
    )


def test_a_program_is_held_to_what_it_read(service: Service, client: httpx.Client, participant: str) -> None:
    """A preview forgets nothing; a rejected model keeps no pre-session test from being made."""
    model = run_test(client, participant)["model_id"]
    client.post(f"/v1/models/{model}/approve", json={})
    with Client(service.url, service.token("lab", "run-test", "read-live", "read-model")) as lab:
        lab.participant(participant)
        client.put(f"{HOME}/profile", json={"current_ma": 7})
        lab.preview(participant)
        with pytest.raises(Conflict):
            lab.start_test(participant)
        lab.participant(participant)
        lab.approved_model(participant)
        client.post(f"/v1/models/{model}/reject", json={"reason": "wrong arm"})
        assert lab.start_test(participant)["state"] in ("requested", "running")


def test_what_a_program_decided_itself_is_no_news_to_it(
    service: Service, client: httpx.Client, participant: str
) -> None:
    """It read the participant and both models once; then it approves, changes limits and starts on what it read."""
    first, second = (run_test(client, participant)["model_id"] for _ in range(2))
    with Client(service.url, TOKEN) as lab:
        lab.participant(participant)
        assert lab.version(first)["id"] == first and lab.version(second)["id"] == second
        assert lab.approve(first)["served"] and lab.approve(second)["served"] and lab.reject(second)["decision"]
        lab.set_limits(participant, current_ma=9.0)
        lab.set_limits(participant, current_ma=8.0)
        lab.archive(participant)
        lab.unarchive(participant)
        assert lab.run_test(participant)["state"] == "completed"
        with pytest.raises(Conflict, match="first version"):
            lab.undo(first)
        assert lab._etags.keys() >= {HOME, f"/v1/models/{first}"}, "nothing was read again"


@pytest.mark.parametrize("other", ["another person", "another program of the same person"])
@pytest.mark.parametrize("when", ["before", "after"])
def test_what_somebody_else_decided_between_ones_own_decisions_is(
    service: Service, client: httpx.Client, participant: str, other: str, when: str
) -> None:
    model = run_test(client, participant)["model_id"]
    text = service.token("colleague", "administer", "run-test") if other == "another person" else TOKEN
    with Client(service.url, TOKEN) as lab, Client(service.url, text) as theirs:
        lab.participant(participant)
        if when == "before":
            theirs.set_limits(participant, current_ma=7.0)
        lab.approve(model, "good")
        if when == "after":
            theirs.set_limits(participant, current_ma=7.0)
        lab._own += [] if other != "another person" else [str(number) for number in range(200)]
        with pytest.raises(Conflict) as caught:
            lab.start_test(participant)
        assert caught.value.document["changes"][-1]["now"]["action"] == "set profile"
        with pytest.raises(Conflict):
            lab.set_limits(participant, current_ma=9.0)
        assert lab.participant(participant)["profile"]["current_ma"] == 7.0
        assert lab.start_test(participant)["state"] in ("requested", "running"), "it has read it now"


def test_another_documents_version_says_nothing_and_several_count_in_any_order(
    service: Service, client: httpx.Client, participant: str
) -> None:
    client.post("/v1/participants", json={"code": "P018"})
    old = client.get(HOME).headers["etag"]
    client.put(f"{HOME}/profile", json={"max_torque_nm": 12})
    new, others = (client.get(f"/v1/participants/{code}").headers["etag"] for code in (participant, "P018"))
    unread = ('"abc"', '"99999999999999999999"', client.get("/v1/rig").headers["etag"], "*")
    for tag, status, words in ((others, 409, "no version of"), *((tag, 428, "Send the ETag of GET") for tag in unread)):
        refused = client.put(f"{HOME}/profile", json={"current_ma": 7}, headers={"If-Match": tag})
        assert refused.status_code == status and f"{words} {HOME}" in refused.json()["detail"], tag
        begun = client.post("/v1/tests", json={"participant": participant}, headers={"If-Match": tag})
        assert begun.status_code == status, tag
    assert service.rig.starts == 0
    assert client.put(f"{HOME}/profile", json={"current_ma": 7}, headers={"If-Match": old}).status_code == 409
    lines = [("If-Match", old), ("If-Match", new)]
    assert client.put(f"{HOME}/profile", json={"current_ma": 9}, headers=lines).is_success, "or in two lines"
    new = client.get(HOME).headers["etag"]
    for number, tags in enumerate((f"{old}, {new}", f'"abc", {others}')):
        both = client.put(f"{HOME}/profile", json={"current_ma": 7 + number}, headers={"If-Match": tags})
        assert both.status_code == (409 if number else 200), both.text


def test_an_entry_of_another_trail_is_no_version(service: Service, client: httpx.Client, participant: str) -> None:
    """As after a backup was restored: the number is there, with another hash."""
    tag = client.get(HOME).headers["etag"]
    mark = tag.split(".")[1]
    other = tag.replace(mark, "".join("0" if one != "0" else "1" for one in mark))
    refused = client.put(f"{HOME}/profile", json={"current_ma": 7}, headers={"If-Match": other})
    assert refused.status_code == 409 and "another database" in refused.json()["detail"]


def test_a_range_that_was_said_under_another_calibration_of_the_sensor_is_asked_for_again(
    service: Service, client: httpx.Client, participant: str
) -> None:
    service.rig.arm.way = still(0.2)
    old = client.get(HOME).headers["etag"]
    assert client.post("/v1/rig/angle/pose", json={"angle_rad": 0.2}).is_success
    asked = {"json": {"angle_range_rad": [0.5, 1.2]}, "headers": {"If-Match": old}}
    assert client.put(f"{HOME}/profile", **asked).status_code == 409
    other = client.put(f"{HOME}/profile", json={"current_ma": 7}, headers={"If-Match": old})
    assert other.is_success
    again = client.put(f"{HOME}/profile", json=asked["json"], headers={"If-Match": other.headers["etag"]})
    assert again.status_code == 409, "limits that were set show no pose"
    assert client.put(f"{HOME}/profile", json=asked["json"]).is_success


def test_a_range_is_said_by_who_read_its_participant_after_the_pose(
    service: Service, client: httpx.Client, participant: str
) -> None:
    """The document's version is at least as new as all that a decision on it is held against."""
    service.rig.arm.way = still(0.2)
    assert client.post("/v1/rig/angle/pose", json={"angle_rad": 0.2}).is_success
    assert client.put(f"{HOME}/profile", json={"angle_range_rad": [0.5, 1.2]}).is_success


def test_a_pose_whose_answer_was_lost_is_a_change(
    service: Service, client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.rig.arm.way = still(0.2)
    old = client.get("/v1/rig/angle").headers["etag"]
    with monkeypatch.context() as patch:
        patch.setattr(service.context.rig, "patience_s", 0.0)
        lost = client.post("/v1/rig/angle/pose", json={"angle_rad": 0.2}, headers={"If-Match": old})
        assert lost.status_code == 503, lost.text
    assert [one["action"] for one in client.get("/v1/audit").json()["entries"]][-1] == "pose not taken"
    second = client.post("/v1/rig/angle/pose", json={"angle_rad": 1.5}, headers={"If-Match": old})
    assert second.status_code == 409 and service.rig.arm.calibration is None


def test_a_models_version_is_a_controllers_only(
    service: Service, client: httpx.Client, participant: str, approved: str
) -> None:
    """A program's test is played within the participant's limits, which the model does not show."""
    lab = service.client(service.token("lab", "run-test", "read-live", "read-model"))
    tag = {"If-Match": lab.get(f"{HOME}/model").headers["etag"]}
    for body in ({}, TRIAL):
        refused = lab.post("/v1/tests", json={"participant": participant, **body}, headers=tag)
        assert refused.status_code == 409 and f"no version of {HOME}" in refused.json()["detail"]
    with Client(service.url, service.token("lib", "run-test", "read-live", "read-model")) as lib:
        lib.participant(participant)
        lib.approved_model(participant)
        client.put(f"{HOME}/profile", json={"current_ma": 25})
        with pytest.raises(Conflict):
            lib.start_test(participant, kind="sequence", segments=TRIAL["segments"])
    assert approved and service.rig.starts == 1


@pytest.mark.parametrize("how", ["its day", "its right, while the store cannot be read", "set muscle", "archive"])
def test_a_trial_that_plays_ends_with(
    service: Service, client: httpx.Client, participant: str, approved: str, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """With the day of its key, its right, or a change of the participant that no request made."""
    playing(service, client, participant)
    context = service.context
    if how == "its day":
        context.runner.clock = Tomorrow(context.clock)
    elif how.startswith("its right"):
        monkeypatch.setattr(context.runner, "overtaking", Mock(side_effect=OSError("the disk is gone")))
        context.runner.current.until_utc = "2026-01-01T00:00:00.000Z"
    else:
        with context.store.write() as session:
            audit.write(session, context.clock.utc(), "somebody elsewhere", how, participant)
    soon(lambda: service.rig.withdrawn)
    assert [request.begun for request in service.rig.withdrawn] == [True] and approved


class Tomorrow(Clock):
    """A day later."""

    def __init__(self, clock: Clock) -> None:
        self.now = clock

    def unix_s(self) -> float:
        return self.now.unix_s() + 86_400.0


def test_a_key_that_ends_between_its_intent_and_its_command_plays_nothing(
    service: Service, client: httpx.Client, participant: str, approved: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is told to the rig at once; and the start that follows is refused here, whatever the rig remembers."""
    _key, controller = key_of(service, client, participant)
    runner = service.context.runner
    write = runner._write_intent

    def then_it_is_tomorrow(*given: Any) -> Any:
        row = write(*given)
        runner.clock = Tomorrow(runner.clock)
        service.run(runner.look_again())
        return row

    monkeypatch.setattr(runner, "_write_intent", then_it_is_tomorrow)
    starts = service.rig.starts
    refused = controller.post("/v1/tests", json={"participant": participant, **TRIAL})
    assert refused.status_code == 409 and refused.json()["title"] == "The right to this test has ended"
    assert service.rig.starts == starts and len(service.rig.withdrawn) == 1 and approved


def test_a_key_that_is_revoked_before_its_intent_plays_nothing(
    service: Service, client: httpx.Client, participant: str, approved: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was good at the door; it is revoked while the plan is looked at."""
    key, controller = key_of(service, client, participant)
    context, starts = service.context, service.rig.starts
    look = context.runner._previewed

    async def meanwhile(plan: Any) -> Any:
        await asyncio.to_thread(context.auth.revoke, key, "somebody elsewhere")
        return await look(plan)

    monkeypatch.setattr(context.runner, "_previewed", meanwhile)
    refused = controller.post("/v1/tests", json={"participant": participant, **TRIAL})
    assert refused.status_code == 409 and refused.json()["title"] == "The right to this test has ended"
    assert service.rig.starts == starts and approved
    assert client.get("/v1/tests").json()[0]["kind"] != "sequence", "no intent was written"


@pytest.mark.parametrize("by_key", [True, False])
def test_a_trial_ends_with_its_makers_token_and_a_programs_test_does_not(
    service: Service, client: httpx.Client, participant: str, approved: str, by_key: bool
) -> None:
    context, starts = service.context, service.rig.starts
    maker = service.client(service.token("clin", "approve-model", "run-test", "read-live", "read-model"))
    if by_key:
        playing(service, client, participant, maker)
    else:
        service.rig.speed = 0.2
        assert maker.post("/v1/tests", json={"participant": participant, **TRIAL}).status_code == 202
    current = context.runner.current
    row = next(row for row in context.store.all(Token) if row.name == "clin")
    with context.store.write() as session:
        session.merge(row).expires_utc = "2026-01-01T00:00:00.000Z"
    current.since, current.until_utc = None, None  # as after a restart of the service: looked up anew
    if by_key:
        soon(lambda: service.rig.withdrawn)
    told = len(service.rig.withdrawn)
    for _ in range(2):
        service.run(context.runner.look_again())
    assert len(service.rig.withdrawn) == told == by_key, "once, and not again"
    assert service.rig.starts == starts + 1 and approved


def test_what_was_seen_before_midnight_is_not_decided_after_it(
    service: Service, client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It passed the door a moment before."""
    tag = client.get(HOME).headers["etag"]
    asked = []

    def ends(*given: Any) -> str:
        asked.append(given)
        return tag.split(".")[2] if len(asked) == 1 else "2999-01-01"

    monkeypatch.setattr(guards, "local_day", ends)
    refused = client.put(f"{HOME}/profile", json={"current_ma": 7}, headers={"If-Match": tag})
    assert refused.status_code == 409 and "Approvals and calibrations end" in refused.json()["detail"]
    assert len(asked) > 1


def test_the_door_is_quick_and_never_fails(service: Service, client: httpx.Client, participant: str) -> None:
    tags = ",".join(f'"1.00000000.2026-11-26.{number:08x}"' for number in range(1500))
    long = client.post("/v1/tests", json={"participant": "x" * 900_000}, headers={"If-Match": tags})
    assert long.status_code == 409 and "{code}" in long.json()["detail"]
    for body in (b"[" * 200_000, b'{"participant": "\\ud800"}', b'{"participant": ["P017"]}', b"null", b"\xff"):
        for head in ({}, {"If-Match": tags}):
            answer = client.post("/v1/tests", content=body, headers={**head, "content-type": "text/plain"}, auth=QUIET)
            assert answer.status_code in (409, 422, 428), answer.text
    assert service.rig.starts == 0


def test_a_rejection_that_brings_a_model_back_needs_what_its_page_showed(
    service: Service, client: httpx.Client, participant: str
) -> None:
    first, second = (run_test(client, participant)["model_id"] for _ in range(2))
    for model in (first, second):
        client.post(f"/v1/models/{model}/approve", json={"reason": "good enough"})
    for head, data in (({"If-Match": '""'}, None), ({"If-Match": ""}, None), ({}, {"reason": "x", "seen": ""})):
        path = f"/models/{second}/reject"
        if data is None:
            refused = client.post(f"/v1{path}", json={"reason": "x"}, headers=head)
        else:
            refused = client.post(path, data=data, auth=QUIET)
        assert refused.status_code == 428, refused.text
    assert client.post(f"/v1/models/{second}/reject", json={"reason": "x"}, auth=QUIET).is_success, "of a program"
    page = client.get(PAGE, headers=HTML).text
    bare = re.findall(r'name="seen" value="([^"]+)"', page)[-1]
    assert client.put(f"{HOME}/profile", json={"current_ma": 7}, headers={"If-Match": f'"{bare}"'}).status_code == 409


def test_limits_are_answered_and_not_what_was_decided_on_models(
    service: Service, client: httpx.Client, participant: str, approved: str
) -> None:
    old = {"If-Match": client.get(HOME).headers["etag"]}
    client.post(f"/v1/models/{approved}/reject", json={"reason": "wrong arm"})
    changed = client.put(f"{HOME}/profile", json={"current_ma": 7}, headers=old)
    assert changed.is_success
    body, answered = {"participant": participant, **TRIAL}, {"If-Match": changed.headers["etag"]}
    assert client.post("/v1/tests", json=body, headers=answered).status_code == 409
    assert service.rig.starts == 1


def test_a_key_is_made_on_what_was_seen_also_when_its_check_is_overtaken(
    service: Service, client: httpx.Client, participant: str, approved: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The form's own look is before the transaction: what comes between is refused there."""
    page, old = client.get(PAGE, headers=HTML).text, client.get(HOME).headers["etag"]
    version = re.findall(r'name="seen" value="([^"]+)"', page)[-1]
    assert client.put(f"{HOME}/profile", json={"max_torque_nm": 12}).is_success
    store = service.context.store
    monkeypatch.setattr(store, "refuse_changed", lambda *_about: None)
    key = {"name": "ilc", "current_ma": "8", "max_pulse_width_us": "200", "max_duration_s": "60", "trials": "3"}
    refused = client.post(f"{PAGE}/keys", data={**key, "seen": version}, headers=HTML, auth=None)
    assert refused.status_code == 409 and approved
    assert "ilc" in refused.text and "trials: 3 of at most 60 s, 8 mA, 200 µs" in refused.text
    assert not [token for token in client.get("/v1/tokens").json() if token["name"].startswith("ilc")]
    begun = client.post("/v1/tests", json={"participant": participant}, headers={"If-Match": old})
    assert begun.status_code == 409 and service.rig.starts == 1, "in the intent's own transaction, too"


def test_the_page_says_what_is_pressed_once_more(pages: httpx.Client, client: httpx.Client, participant: str) -> None:
    model = run_test(client, participant)["model_id"]
    form = {**fields(pages), "csrf": csrf(pages)}
    client.put(f"{HOME}/muscle", json={"side": "right", "muscle": "triceps brachii"})
    site = pages.post(f"{PAGE}/muscle", data={**form, "side": "left", "muscle": "biceps brachii", "placement": "B"})
    assert "You wanted: left, biceps brachii, B" in site.text
    assert "Set this side and muscle all the same" in site.text
    client.post(f"{HOME}/archive")
    again = pages.post(f"{PAGE}/archive", data=form).text
    assert re.search(r"not in the archive.*<b>in the archive</b>", again, re.DOTALL)
    client.post(f"{HOME}/unarchive")
    client.put(f"{HOME}/muscle", json={})
    version = re.findall(r'name="seen" value="([^"]+)"', pages.get(f"/models/{model}").text)[-1]
    client.post(f"/v1/models/{model}/reject", json={"reason": "wrong arm"})
    data = {"csrf": form["csrf"], "seen": version, "reason": "good enough"}
    refused = pages.post(f"/models/{model}/approve", data=data).text
    assert f'<a href="/models/{model}">Model {model[:8]}</a>' in refused and "wrong arm" in refused


def test_a_result_of_other_limits_is_not_offered_once_more(
    service: Service, pages: httpx.Client, client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    at = f"{HOME}/calibration"
    client.post(at, json={})
    client.post(f"{at}/step", json={"direction": "up"})
    limits = {"current_ma": 20.0, "max_pulse_width_us": 250.0, "max_torque_nm": 30.0}
    result = m.CalibrationResult.model_validate({"profile": limits, "recordings": []})
    service.rig.calibrated = finished(service).model_copy(update={"result": result})
    version = client.get(at).headers["etag"].strip('"')
    client.put(f"{HOME}/profile", json={"max_torque_nm": 12})
    refused = pages.post(f"{PAGE}/calibration/finish", data={"csrf": csrf(pages), "calibration": version})
    assert refused.status_code == 409 and "12 N·m" in refused.text
    assert "all the same" not in refused.text


def test_a_page_is_as_old_as_its_own_request_also_right_behind_another_on_its_connection(
    pages: httpx.Client, participant: str
) -> None:
    """A browser asks on as soon as an answer has come, before it has ended here; the next request began within it."""
    sent = inputs(pages.get(PAGE).text, f"{PAGE}/profile")
    pages.headers["Accept-Encoding"] = "identity"
    posted = pages.build_request("POST", f"{PAGE}/profile", data=sent | {"current_ma": "7"})
    asked = pages.build_request("GET", PAGE, headers={"Connection": "close"})
    with socket.create_connection((asked.url.host, asked.url.port), timeout=60) as line:
        for request in (posted, asked):
            lines = [
                f"{request.method} {request.url.raw_path.decode()} HTTP/1.1",
                *map(": ".join, request.headers.items()),
            ]
            line.sendall("\r\n".join([*lines, "", ""]).encode() + request.content)
        answers = b"".join(iter(partial(line.recv, 65536), b"")).decode()
    assert " 303 " in answers.partition("\r\n")[0]
    before, shown = int(sent["seen"].partition(".")[0]), re.findall(r'name="seen" value="(\d+)', answers)
    assert {int(entry) > before for entry in shown} == {True}, (before, shown)

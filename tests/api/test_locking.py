"""Attacks on decisions that were made on something older: each stays refused."""

from __future__ import annotations

import asyncio
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import pytest

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.people.auth import Scope
from stimrig.api.sessions import playing as playing_module
from stimrig.api.store import Store, locking
from stimrig.api.store.tables import Participant, Token
from stimrig.rig import messages as m
from stimrig.rig.requests import WithdrawRequest
from tests.api.conftest import Service, run_test, soon
from tests.api.fake_arm import still
from tests.api.test_overtaken import CHANGES, RIGHTS, TRIAL, key_of
from tests.api.test_profiles import mark_all

QUIET: Any = None
"""A client that sends no version by itself."""
HOME = "/v1/participants/P017"
KEY = {"name": "ilc", "current_ma": 8, "max_pulse_width_us": 200, "max_duration_s": 60, "trials": 3}


def test_a_restored_backup_takes_no_version_that_was_shown_before_it(tmp_path: Path) -> None:
    """The number of the entry comes again, with another hash; a decision made on the old one is refused."""
    live, backup = tmp_path / "stimrig.db", tmp_path / "backup.db"
    at_utc = "2026-11-23T10:00:00.000Z"

    def change(current_ma: float, tags: locking.Tags | None) -> int:
        with closing(Store(f"sqlite:///{live}")) as store, store.write() as session:
            row = session.get(Participant, "P1") or Participant(code="P1", created_utc=at_utc, created_by="Ada")
            if tags is not None:
                locking.check(session, row, tags)
            row.profile = {"current_ma": current_ma}
            locking.write(session, row, at_utc, "Ada", "set profile", "P1", profile=row.profile)
            session.add(row)
        return row.version

    first = change(20.0, None)
    shutil.copy(live, backup)
    shown = change(5.0, (str(first),))
    for beside in live.parent.glob("stimrig.db*"):
        beside.unlink()
    shutil.copy(backup, live)
    again = change(30.0, (str(first),))
    assert again >> 24 == shown >> 24 and again != shown
    with pytest.raises(locking.ChangedError) as caught:
        change(20.0, (str(shown),))
    assert caught.value.status == 412 and caught.value.extra["changes"] == []
    with pytest.raises(locking.ChangedError) as caught:
        change(20.0, (str(first), '"', "9" * 30))
    (told,) = caught.value.extra["changes"]
    assert (told["who"], told["old"], told["new"]) == ("Ada", "current 20.0 mA", "current 30.0 mA")


def test_who_decides_again_sends_the_version_of_the_answer(client: httpx.Client, participant: str) -> None:
    model = run_test(client, participant)["model_id"]
    tag = client.get(HOME).headers["etag"]
    for method, path, body in (
        ("PUT", f"{HOME}/profile", {"current_ma": 9}), ("POST", f"/v1/models/{model}/approve", {}),
        ("PUT", f"{HOME}/muscle", {"side": "left"}), ("POST", f"{HOME}/keys", KEY),
        ("POST", f"/v1/models/{model}/reject", {"reason": "wrong arm"}),
    ):  # fmt: skip
        old, answer = tag, client.request(method, path, json=body, headers={"If-Match": tag})
        assert answer.is_success, answer.text
        tag = answer.headers["etag"]
        assert (
            tag != old and tag == client.get(HOME).headers["etag"] == client.get(f"/v1/models/{model}").headers["etag"]
        )
    assert client.post("/v1/tests", json={"participant": participant}, headers={"If-Match": tag}).status_code == 202


def test_another_documents_version_says_nothing_and_of_several_one_is_enough(
    service: Service, client: httpx.Client, participant: str
) -> None:
    client.post("/v1/participants", json={"code": "P018"})
    old = client.get(HOME).headers["etag"]
    client.put(f"{HOME}/profile", json={"max_torque_nm": 12})
    new, others = (client.get(f"/v1/participants/{code}").headers["etag"] for code in (participant, "P018"))
    latch = client.get("/v1/rig").headers["etag"]
    for tag, status in ((others, 412), ('"abc"', 412), (latch, 412), ('"99999999999999999999"', 412), ("*", 428)):
        head = {"If-Match": tag}
        refused = client.put(f"{HOME}/profile", json={"current_ma": 7}, headers=head)
        assert refused.status_code == status, tag
        assert client.post("/v1/tests", json={"participant": participant}, headers=head).status_code == status
    assert "GET /v1/participants/P017 as If-Match" in refused.json()["detail"]
    lines = [("If-Match", old), ("If-Match", new)]
    assert client.put(f"{HOME}/profile", json={"current_ma": 9}, headers=lines).is_success, "or in two lines"
    new = client.get(HOME).headers["etag"]
    assert client.put(f"{HOME}/profile", json={"current_ma": 8}, headers={"If-Match": f"{old}, W/{new}"}).is_success
    assert service.rig.starts == 0


def test_whatever_is_sent_as_a_version_is_refused_quickly(
    service: Service, client: httpx.Client, participant: str
) -> None:
    tags = ",".join(f'"{number}"' for number in range(1500))
    for body in (b"[" * 200_000, b'{"participant": "\\ud800"}', b'{"participant": ["P017"]}', b"null", b"\xff"):
        for head in ({}, {"If-Match": tags}):
            answer = client.post("/v1/tests", content=body, headers={**head, "content-type": "text/plain"}, auth=QUIET)
            assert answer.status_code in (412, 422, 428), answer.text
    assert service.rig.starts == 0 and participant


def test_a_models_version_is_a_controllers_only(
    service: Service, client: httpx.Client, participant: str, approved: str
) -> None:
    """A program's test is played within the participant's limits, which the model does not show."""
    lab = service.client(service.token("lab", "run-test", "read-live", "read-model"))
    tag = {"If-Match": lab.get(f"{HOME}/model").headers["etag"]}
    for body in ({}, TRIAL):
        assert lab.post("/v1/tests", json={"participant": participant, **body}, headers=tag).status_code == 412
    assert approved and service.rig.starts == 1


def test_a_rejection_that_brings_a_model_back_is_made_on_a_version(client: httpx.Client, participant: str) -> None:
    first, second = (run_test(client, participant)["model_id"] for _ in range(2))
    for model in (first, second):
        client.post(f"/v1/models/{model}/approve", json={"reason": "good enough"})
    reject, read = f"/v1/models/{second}/reject", client.get(HOME).headers["etag"]
    assert client.put(f"{HOME}/profile", json={"current_ma": 9}).is_success
    for tag in ('""', ""):
        assert client.post(reject, json={"reason": "x"}, headers={"If-Match": tag}).status_code == 428
    assert client.post(reject, json={"reason": "x"}, headers={"If-Match": read}).status_code == 412
    of_a_program = client.post(reject, json={"reason": "x"}, auth=QUIET)
    assert of_a_program.is_success and "etag" not in of_a_program.headers, "what others decided was not read"


def test_why_a_model_was_decided_on_is_told_to_nobody_who_only_tests(
    service: Service, client: httpx.Client, participant: str, approved: str
) -> None:
    lab = service.client(service.token("lab", "run-test"))
    old = {"If-Match": lab.get(HOME).headers["etag"]}
    client.post(f"/v1/models/{approved}/reject", json={"reason": "wrong arm"})
    refused = lab.put(f"{HOME}/profile", json={"current_ma": 7}, headers=old)
    assert refused.status_code == 412 and "wrong arm" not in refused.text
    (change,) = refused.json()["changes"]
    assert (change["who"], change["subject"], change["old"], change["new"]) == (
        "administrator", approved, "approve", "reject"
    )  # fmt: skip


# ---- the angle sensor and the calibration -------------------------------------------------------------------------


def test_a_range_is_set_by_who_read_the_participant_after_the_last_pose(
    service: Service, client: httpx.Client, participant: str
) -> None:
    service.rig.arm.way = still(0.2)
    old = {"If-Match": client.get(HOME).headers["etag"]}
    assert client.post("/v1/rig/angle/pose", json={"angle_rad": 0.2}).is_success
    asked = {"angle_range_rad": [0.5, 1.2]}
    refused = client.put(f"{HOME}/profile", json=asked, headers=old)
    assert refused.status_code == 412 and refused.json()["changes"][-1]["action"] == "pose of the angle sensor"
    assert client.put(f"{HOME}/profile", json=asked).is_success


def test_a_pose_whose_answer_was_lost_is_a_change(
    service: Service, client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.rig.arm.way = still(0.2)
    old = {"If-Match": client.get("/v1/rig/angle").headers["etag"]}
    with monkeypatch.context() as patch:
        patch.setattr(service.context.rig, "patience_s", 0.0)
        assert client.post("/v1/rig/angle/pose", json={"angle_rad": 0.2}, headers=old).status_code == 503
    assert client.get("/v1/audit").json()["entries"][-1]["action"] == "pose not taken"
    assert client.post("/v1/rig/angle/pose", json={"angle_rad": 1.5}, headers=old).status_code == 412
    assert service.rig.arm.calibration is None and participant


def finished(service: Service, **result: Any) -> Any:
    """As if the service had not heard the rig's answer."""
    open_one = service.rig.calibration
    assert open_one is not None
    service.rig.calibration, service.rig.state = None, "ready"
    return m.Calibrated(
        calibration_id=open_one.calibration_id, participant=open_one.participant, by="x",
        result=m.CalibrationResult.model_validate(result),
    )  # fmt: skip


def test_a_waiting_result_is_let_go_by_who_knows_its_calibration(
    service: Service, client: httpx.Client, participant: str
) -> None:
    at = f"{HOME}/calibration"
    client.post(at, json={})
    mark_all(client)
    found = client.get(at).json()
    service.rig.calibrated = finished(service)
    missing = client.get(at)
    assert missing.status_code == 404 and missing.headers["etag"] == f'"{found["calibration_id"]}.0"'
    for tag, status in (('"C20200101T000000-000000-1.3"', 412), (missing.headers["etag"], 200)):
        sent = client.post(f"{at}/discard", headers={"If-Match": tag})
        assert sent.status_code == status, sent.text
        assert (status == 412) == ("has begun another calibration since this page" in sent.text)
    assert service.rig.calibrated is None and participant


def test_a_result_of_other_limits_is_not_stored(service: Service, client: httpx.Client, participant: str) -> None:
    """A decision on a model is none on limits: with it the calibration goes on."""
    model, at = run_test(client, participant)["model_id"], f"{HOME}/calibration"
    client.post(at, json={})
    client.post(f"{at}/step", json={"direction": "up"})
    assert client.post(f"/v1/models/{model}/approve", json={}).is_success
    assert client.get(at).json()["outdated"] == ""
    limits = {"current_ma": 20.0, "max_pulse_width_us": 250.0, "max_torque_nm": 30.0}
    service.rig.calibrated = finished(service, profile=limits, recordings=[])
    version = client.get(at).headers["etag"]
    client.put(f"{HOME}/profile", json={"max_torque_nm": 12})
    refused = client.post(f"{at}/finish", headers={"If-Match": version})
    assert refused.status_code == 409 and "12 N·m" in refused.text
    assert client.get(HOME).json()["profile"]["max_pulse_width_us"] != 250.0


# ---- the right to a trial ------------------------------------------------------------------------------------------


def playing(service: Service, client: httpx.Client, code: str, maker: httpx.Client | None = None) -> str:
    """A controller's trial plays; the public id of its key."""
    key, controller = key_of(service, client, code, maker)
    service.rig.speed = 0.2
    assert controller.post("/v1/tests", json={"participant": code, **TRIAL}).status_code == 202
    return key


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
    assert client.delete(f"{HOME}/keys/{key}").status_code == 204
    soon(lambda: service.rig.stopped_by == "service")
    assert approved and failed


@pytest.mark.parametrize("same_text", [True, False])
def test_a_token_that_came_back_starts_tests(service: Service, participant: str, same_text: bool) -> None:
    text, auth = service.token("lab", "run-test", "read-live"), service.context.auth
    (known,) = [row for row in service.context.store.all(Token) if row.name == "lab"]
    assert auth.revoke(known.hash[:16], "somebody")
    again = auth.issue("lab", [Scope.RUN_TEST, Scope.READ_LIVE], "somebody", text=text if same_text else None)
    assert service.client(again).post("/v1/tests", json={"participant": participant}).status_code == 202


@pytest.mark.parametrize("how", [
    "its day", "its right, while the store cannot be read", "set muscle", "revoked elsewhere",
    "its maker revoked", *RIGHTS,
])  # fmt: skip
def test_a_trial_that_plays_ends_with(
    service: Service, client: httpx.Client, participant: str, approved: str, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """With the day of its key, its right, or a change of the participant, also one that no request made."""
    maker = service.client(service.token("clin", "approve-model", "run-test", "read-live", "read-model"))
    key, context = playing(service, client, participant, maker), service.context
    if how == "its day":
        context.runner.clock = Tomorrow(context.clock)
    elif how.startswith("its right"):
        monkeypatch.setattr(context.runner, "find_changes", Mock(side_effect=OSError("the disk is gone")))
        context.runner.current.until_utc = "2026-01-01T00:00:00.000Z"
    elif how == "revoked elsewhere":
        assert context.auth.revoke(key, "somebody elsewhere")
    elif how == "its maker revoked":
        of_maker = next(token["id"] for token in client.get("/v1/tokens").json() if token["name"] == "clin")
        assert client.delete(f"/v1/tokens/{of_maker}").status_code == 204
    elif how in RIGHTS:
        assert CHANGES[how](client, participant, key, approved).is_success
        assert service.rig.withdrawn, "the rig knows before the change is answered"
    else:
        with context.store.write() as session:
            row = session.get(Participant, participant)
            locking.write(session, row, context.clock.utc(), "somebody elsewhere", how, participant)
    soon(lambda: service.rig.withdrawn)
    assert [request.begun for request in service.rig.withdrawn] == [True] and playing_module.LOOK_AGAIN_S <= 0.25


class Tomorrow(Clock):
    """A day later."""

    def __init__(self, clock: Clock) -> None:
        self.now = clock

    def unix_s(self) -> float:
        return self.now.unix_s() + 86_400.0


@pytest.mark.parametrize("when", ["its intent", "its command"])
def test_a_key_that_ends_before(
    service: Service, client: httpx.Client, participant: str, approved: str, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    """It was good when it was asked. The start that follows is refused here, whatever the rig remembers."""
    key, controller = key_of(service, client, participant)
    context, runner = service.context, service.context.runner
    look, write = runner._previewed, runner._write_intent

    async def revoked(plan: Any) -> Any:
        await asyncio.to_thread(context.auth.revoke, key, "somebody elsewhere")
        return await look(plan)

    def then_it_is_tomorrow(*given: Any) -> Any:
        row = write(*given)
        runner.clock = Tomorrow(runner.clock)
        service.run(runner.look_again())
        return row

    if when == "its intent":
        monkeypatch.setattr(runner, "_previewed", revoked)
    else:
        monkeypatch.setattr(runner, "_write_intent", then_it_is_tomorrow)
    starts = service.rig.starts
    refused = controller.post("/v1/tests", json={"participant": participant, **TRIAL})
    assert refused.status_code == 409 and refused.json()["title"] == "The right to this test has ended"
    written = client.get("/v1/tests").json()[0]["kind"] == "sequence"
    assert service.rig.starts == starts and approved and written == (when == "its command")
    assert len(service.rig.withdrawn) == written, "the rig is told at once"


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
    row = next(row for row in context.store.all(Token) if row.name == "clin")
    service.change(Token, row.hash, expires_utc="2026-01-01T00:00:00.000Z")
    context.runner.current = None
    service.run(context.runner.resume())  # a restart of the service looks the right up anew
    if by_key:
        soon(lambda: service.rig.withdrawn)
    told = len(service.rig.withdrawn)
    for _ in range(2):
        service.run(context.runner.look_again())
    assert len(service.rig.withdrawn) == told == by_key, "once, and not again"
    assert service.rig.starts == starts + 1 and approved

"""A session through REST, from participant to controller; whatever fails, no test stays open and none holds the rig."""

from __future__ import annotations

import asyncio
import json
import threading
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.sessions import playing
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store import Store, database
from stimrig.rig.messages import Reply, StateEvent, Status
from stimrig.rig.requests import StartRequest
from tests.api.clinic import Clinic
from tests.api.conftest import DURABLE, Service, let_go, run_test, soon, wait_done


def test_whole_path_to_the_controller(client: httpx.Client, service: Service, participant: str) -> None:
    started = client.post("/v1/tests", json={"participant": participant})
    assert started.status_code == 202
    assert started.headers["location"] == f"/v1/tests/{started.json()['id']}"
    document = wait_done(client, started.json()["id"])
    assert document["state"] == "completed"
    assert document["summary"]["samples"] == 9600 + 400
    assert document["summary"]["last_sample_to_model_s"] < 5
    model_url = document["model_url"]
    assert client.get(f"/v1/participants/{participant}/model").status_code == 404
    approved = client.post(f"{model_url}/approve", json={"reason": "good fit"}).json()
    assert approved["served"] and approved["decision"] == "approved"

    controller = service.client(service.token("controller", "read-model"))
    path = f"/v1/participants/{participant}/model"
    first = controller.get(path)
    assert first.status_code == 200 and first.json()["model_id"] == document["model_id"]
    etag = first.headers["etag"]
    for sent, status in ((etag, 304), (f'"x", W/{etag}', 304), ('"other"', 200)):
        again = controller.get(path, headers={"If-None-Match": sent})
        assert again.status_code == status and (
            status == 200 or (again.content == b"" and again.headers["etag"] == etag)
        )


def test_newer_model_does_not_replace_the_approved_one_and_rejection_withdraws(client: httpx.Client, participant: str):
    first = run_test(client, participant)
    client.post(f"{first['model_url']}/approve")
    second = run_test(client, participant)
    served = client.get(f"/v1/participants/{participant}/model").json()
    assert served["model_id"] == first["model_id"] != second["model_id"]
    versions = client.get(f"/v1/participants/{participant}/models").json()
    assert [v["id"] for v in versions] == [second["model_id"], first["model_id"]]
    client.post(f"{second['model_url']}/approve")
    assert client.get(f"/v1/participants/{participant}/model").json()["model_id"] == second["model_id"]
    client.post(f"{second['model_url']}/reject", json={"reason": "electrode slipped"})
    assert client.get(f"/v1/participants/{participant}/model").json()["model_id"] == first["model_id"]


def test_effect_makes_a_new_version_with_lineage(client: httpx.Client, participant: str) -> None:
    parent = run_test(client, participant)["model_id"]
    made = client.post(f"/v1/models/{parent}/effects", json={"effects": ["fatigue"]})
    assert made.status_code == 201, made.text
    child = made.json()
    assert child["parent_id"] == parent and child["added_effect"] == "fatigue" and child["effects"] == ["fatigue"]
    assert made.headers["location"] == f"/v1/models/{child['id']}"
    same = client.post(f"/v1/models/{parent}/effects", json={"effects": ["fatigue"]})
    assert same.json()["id"] == child["id"], "it is there already"
    twice = client.post(f"/v1/models/{child['id']}/effects", json={"effects": ["fatigue"]})
    assert twice.status_code == 409
    refused = client.post(f"/v1/models/{parent}/effects", json={"effects": ["phlogiston"]})
    assert refused.status_code == 422 and "Take one of" in refused.json()["detail"]
    assert client.get(f"/v1/models/{parent}").json()["effects"] == []


def test_live_channel_tells_history_frames_and_the_end(client: httpx.Client, service: Service, participant: str):
    service.rig.speed = 1.0
    test_id = client.post("/v1/tests", json={"participant": participant}).json()["id"]
    soon(lambda: client.get(f"/v1/tests/{test_id}").json()["elapsed_s"] >= 0.5, 20)
    with service.live(test_id) as socket:
        messages = []
        for text in socket:
            messages.append(json.loads(text))
            if len(messages) == 20:
                service.rig.speed = 30.0  # enough was seen live: to the end
    assert messages[0]["type"] == "history" and len(messages[0]["time_s"]) > 4
    frames = [message for message in messages if message["type"] == "live"]
    assert len(frames) > 5
    times = messages[0]["time_s"] + [t for frame in frames for t in frame["time_s"]]
    assert times == sorted(times) and times[0] == 0.0
    assert messages[-1]["type"] == "test" and messages[-1]["test"]["state"] == "completed"
    states = [message["test"]["state"] for message in messages if message["type"] == "test"]
    assert "identifying" in states


def test_recording_comes_back_byte_for_byte(client: httpx.Client, service: Service, participant: str) -> None:
    document = run_test(client, participant)
    answer = client.get(document["recording_url"])
    path = service.data / "recordings" / f"{document['recording_id']}.h5"
    assert answer.content == path.read_bytes()
    path.unlink()
    gone = client.get(document["recording_url"])
    assert gone.status_code == 410 and gone.json()["title"] == "The recording's file is missing"


def come_to_rest(pool: Any) -> None:
    """Wait until no worker has anything to do."""
    soon(lambda: not (pool.queue or any(worker.job for worker in pool.workers)), 60)


def test_comparison_and_diagnosis_are_made_once_and_kept(client: httpx.Client, service: Service, participant: str):
    model = run_test(client, participant)["model_url"]
    diagnosis = client.get(f"{model}/diagnosis").json()
    assert diagnosis["verdict"] == "effect_missing"
    comparison = client.get(f"{model}/comparison").json()
    pool = service.context.pool
    come_to_rest(pool)  # a worker that still warms up counts, too
    done = pool.done_count
    assert client.get(f"{model}/comparison").json() == comparison
    assert client.get(f"{model}/diagnosis").json() == diagnosis
    come_to_rest(pool)
    assert pool.done_count == done


def test_refused_plan_says_why_and_is_kept(client: httpx.Client, participant: str) -> None:
    body = {"participant": participant, "segments": [{"name": "x", "sequence": "polka"}]}
    answer = client.post("/v1/tests", json=body)
    assert answer.status_code == 422 and "'polka'" in answer.json()["detail"]
    assert client.get("/v1/rig").json()["holder"] is None
    assert client.post("/v1/tests", json={"participant": participant}).status_code == 202


def test_a_test_may_name_its_protocol(client: httpx.Client, service: Service, participant: str) -> None:
    both = {"protocol": "short", "segments": [{"name": "x", "sequence": "rest"}]}
    for wrong in (both, {"protocol": "../short"}, {"protocol": True}):
        assert client.post("/v1/tests", json={"participant": participant, **wrong}).status_code == 422
    assert service.rig.starts == 0
    assert client.post("/v1/tests", json={"participant": participant, "protocol": "short"}).status_code == 202
    assert (service.rig.last_plan.protocol, service.rig.last_plan.segments) == ("short", None)


def test_preview_plays_nothing(client: httpx.Client, service: Service, participant: str) -> None:
    answer = client.post("/v1/preview", json={"participant": participant}).json()
    assert answer["duration_s"] == 25.0 and len(answer["pulse_width_us"]) == 1000
    assert service.rig.starts == 0


def test_every_deed_is_in_the_audit_trail_and_the_chain_holds(client: httpx.Client, service: Service, participant: str):
    document = run_test(client, participant)
    client.post(f"{document['model_url']}/approve", json={"reason": "looks right"})
    trail = client.get("/v1/audit").json()
    deeds = [(entry["who"], entry["action"], entry["subject"]) for entry in trail["entries"]]
    assert trail["whole"]
    assert ("administrator", "start test", document["id"]) in deeds
    assert ("administrator", "approve", document["model_id"]) in deeds
    service.sql("UPDATE audit SET who = 'nobody' WHERE seq = 3")
    broken = client.get("/v1/audit").json()
    assert not broken["whole"] and broken["first_broken"] == 3


def test_database_is_durable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "_durable_sqlite", DURABLE)
    store = Store(f"sqlite:///{tmp_path}/durable.db")
    with store.engine.connect() as connection:
        assert connection.exec_driver_sql("PRAGMA journal_mode").scalar() == "wal"
        assert connection.exec_driver_sql("PRAGMA synchronous").scalar() == 2
    store.close()


def test_version_with_other_contents_is_refused_and_the_old_one_stays(tmp_path: Path) -> None:
    clinic = Clinic(tmp_path)
    row = clinic.model()
    before = bytes(row.document)
    document = json.loads(before)
    document["recruitment"]["torque_nm"][-1] += 1.0
    with pytest.raises(ApiError, match="cannot be changed"):
        clinic.versions.add(json.dumps(document), "P017", row.recording_id, "somebody")
    assert clinic.versions.add(before.decode(), "P017", row.recording_id, "somebody").created_by == "Ada"
    assert bytes(clinic.versions.get(row.id).document) == before


# ---- Whatever fails unexpectedly, no test stays open for ever and none holds the rig ---------------------------------


def fails(*_args: Any, **_more: Any) -> Any:
    raise RuntimeError("something\nunexpected")


@pytest.mark.parametrize("with_recording", [True, False])
def test_a_test_taken_up_after_a_restart_ends_whatever_fails(
    client: httpx.Client, service: Service, participant: str, monkeypatch: pytest.MonkeyPatch, with_recording: bool
) -> None:
    context = service.context
    ended = run_test(client, participant)
    without = {} if with_recording else {"recording_id": None}
    context.runner.lifecycle.update(ended["id"], state="identifying", model_id=None, **without)
    broken = (context.versions, "add") if with_recording else (context.runner.lifecycle, "missed_end")
    monkeypatch.setattr(*broken, fails)
    queue = context.runner.hub.open()
    service.run(context.runner.resume())
    now = wait_done(client, ended["id"], 20)
    assert now["state"] == "failed" and now["reason"] == "something unexpected"
    soon(lambda: not queue.empty() and (queue.get_nowait().get("test") or {}).get("state") == "failed", 20)
    monkeypatch.undo()
    assert let_go(client)
    assert run_test(client, participant)["state"] == "completed"


def test_a_start_between_a_tests_end_and_the_rig_let_go_waits(
    client: httpx.Client, service: Service, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The database says that a test is done a moment before the rig is let go: on a busy machine clients met a 409."""
    lifecycle, written_down = service.context.runner.lifecycle, threading.Event()
    fail = lifecycle.fail

    def fails_slowly(test_id: str, error: Exception) -> None:
        fail(test_id, error)
        assert written_down.wait(60)

    monkeypatch.setattr(lifecycle, "take_recording", fails)
    monkeypatch.setattr(lifecycle, "fail", fails_slowly)
    monkeypatch.setattr(playing, "ENDING_S", 60.0)
    first = run_test(client, participant)
    assert first["state"] == "failed" and client.get("/v1/rig").json()["holder"]["test_id"] == first["id"]
    threading.Timer(0.3, written_down.set).start()
    assert client.post("/v1/tests", json={"participant": participant}).status_code == 202
    assert written_down.is_set()


def test_what_has_ended_is_not_called_failed_by_what_goes_wrong_later(
    client: httpx.Client, service: Service, participant: str
) -> None:
    ended = run_test(client, participant)
    service.context.runner.lifecycle.fail(ended["id"], RuntimeError("late"))
    now = client.get(f"/v1/tests/{ended['id']}").json()
    assert (now["state"], now["reason"]) == ("completed", ended["reason"])


def test_a_start_that_fails_unexpectedly_is_stopped_and_leaves_nothing_open(
    service: Service, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = service.context.rig
    ask = rig.ask

    async def broken(message: Any, timeout_s: float | None = None) -> Any:
        if isinstance(message, StartRequest):
            fails()
        return await ask(message, timeout_s)

    monkeypatch.setattr(rig, "ask", broken)
    with service.client(headers={"Connection": "close"}) as client:
        assert client.post("/v1/tests", json={"participant": participant}).status_code == 500
        (test,) = client.get("/v1/tests").json()
        assert test["state"] == "failed" and test["reason"] == "something unexpected"
        assert service.rig.stopped_by == "service", "the rig may have heard the start all the same"
        assert client.get("/v1/rig").json()["holder"] is None


def test_an_end_that_was_never_told_is_found_by_asking(client: httpx.Client, service: Service, participant: str):
    service.rig.loses_ends = True
    ended = run_test(client, participant)
    assert ended["recording_id"] == f"R-{ended['id']}" and ended["state"] == "completed" and ended["model_id"]
    service.rig.loses_ends = False
    assert let_go(client)
    assert run_test(client, participant)["state"] == "completed"
    ends = [e for e in client.get("/v1/audit").json()["entries"] if e["action"].startswith("test ")]
    assert len(ends) == 2, "each end is written down once"


def test_a_failing_listener_costs_nobody_else_the_news(client: httpx.Client, service: Service, participant: str):
    """The first events come while the start is under way: a link that broke there made the start a 503."""
    told: list[str] = []

    def always(news: Any) -> None:
        told.append(type(news).__name__)
        raise RuntimeError("unexpected")

    service.context.rig.listeners.insert(0, always)
    assert run_test(client, participant)["state"] == "completed"
    assert {"StateEvent", "LiveEvent", "FinishedEvent"} <= set(told)
    soon(lambda: told.count("Status") >= 2, 20)  # nor does it end the polling
    assert "bool" not in told, "the link did not break"


def test_a_message_that_cannot_be_taken_costs_one_connection_at_most(
    client: httpx.Client, service: Service, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unexpected error outside a listener; a service that never connects again hears of no test's end."""
    rig, failures = service.context.rig, []

    def once(message: dict[str, Any]) -> None:
        if not failures:
            failures.append(message)
            raise RuntimeError("unexpected")
        RigClient._receive(rig, message)

    monkeypatch.setattr(rig, "_receive", once)
    soon(lambda: failures and rig.connected, 20)  # its next poll is the message; then it connects anew
    assert run_test(client, participant)["state"] == "completed"


def test_a_stop_told_behind_an_answer_outlasts_that_answer(short_dir: Path) -> None:
    """Both came while this process stood still: the state of before is not kept over the stop's."""
    ready = Status.model_validate({"state": "ready", "latch": "1"})
    stopped = Status.model_validate({"state": "latched", "reason": "pain", "latch": "2"})

    async def rig(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for kind, more in (("subscribe", ""), ("status", StateEvent(status=stopped).model_dump_json() + "\n")):
            asked = json.loads(await reader.readline())
            assert asked["kind"] == kind
            reply = Reply(id=asked["id"], ok=True, body=ready.model_dump())
            writer.write((reply.model_dump_json() + "\n" + more).encode())
        await reader.read()
        writer.close()

    async def ask() -> None:
        async with await asyncio.start_unix_server(rig, str(short_dir / "rig")):
            link = RigClient(short_dir / "rig", Clock())
            link.start()
            while not link.connected:
                await asyncio.sleep(0.01)
            assert await link.fresh_status() == link.status == stopped
            await link.close()

    asyncio.run(ask())

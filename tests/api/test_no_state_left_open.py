"""Whatever fails unexpectedly, no test stays open for ever and none holds the rig."""

from __future__ import annotations

import asyncio
import json
import threading
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.clock import Clock
from stimrig.api.sessions import playing
from stimrig.api.sessions.rig_client import RigClient
from stimrig.rig.messages import Reply, StateEvent, Status
from stimrig.rig.requests import StartRequest
from tests.api.conftest import Service, let_go, run_test, soon, wait_done


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

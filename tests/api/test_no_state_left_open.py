"""Whatever fails unexpectedly, no test stays open for ever and none holds the rig."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from typing import Any

import httpx
import pytest

from api.sessions import runner
from rig.messages import StartRequest
from tests.api.conftest import Service, let_go, run_test, wait_done


def fails(*_args: Any, **_more: Any) -> Any:
    raise RuntimeError("something\nunexpected")


def reopened(service: Service, ended: dict[str, Any], **fields: Any) -> Any:
    """What a restarted service finds: the test is open; gives the function that takes it up."""
    context = service.app.state.context
    context.runner.lifecycle.update(ended["id"], state="identifying", model_id=None, followed_by="dead", **fields)

    def resume() -> None:
        asyncio.run_coroutine_threadsafe(context.runner.resume(), context.rig._task.get_loop()).result(30)

    return resume


@pytest.mark.parametrize("with_recording", [True, False])
def test_a_test_taken_up_after_a_restart_ends_whatever_fails(
    client: httpx.Client,
    service: Service,
    participant: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    with_recording: bool,
) -> None:
    context = service.app.state.context
    ended = run_test(client, participant)
    resume = reopened(service, ended, **({} if with_recording else {"recording_id": None}))
    broken = (context.versions, "add") if with_recording else (context.runner.lifecycle, "missed_end")
    monkeypatch.setattr(*broken, fails)
    queue = context.runner.hub.open()
    with caplog.at_level(logging.ERROR, logger="stimrig.trials"):
        resume()
        now = wait_done(client, ended["id"], 20)
    assert now["state"] == "failed" and now["reason"] == "something unexpected"
    assert [record.test_id for record in caplog.records if record.exc_info] == [ended["id"]]  # pyright: ignore[reportAttributeAccessIssue]
    assert "failed" in told_of(queue, "failed"), "open pages hear of it"
    monkeypatch.undo()
    assert let_go(client)
    # a step of the fit may be told after it, too: with what is written down by then
    assert set(told_of(queue, "", 0.1)) <= {"failed"}, "nothing else is heard after it"
    assert run_test(client, participant)["state"] == "completed"


def told_of(queue: asyncio.Queue[dict[str, Any]], state: str, limit_s: float = 20.0) -> list[str]:
    """What open pages hear of a test's state, until it is this one: they hear it after it is written down."""
    end = time.monotonic() + limit_s
    heard: list[str] = []
    while time.monotonic() < end:
        while not queue.empty():
            message = queue.get_nowait()
            heard += [message["test"]["state"]] if message["type"] == "test" else []
            if state in heard:
                return heard
        time.sleep(0.02)
    return heard


def test_a_start_between_a_tests_end_and_the_rig_let_go_waits(
    client: httpx.Client, service: Service, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The database says that a test is done a moment before the rig is let go: on a busy machine clients met a 409."""
    lifecycle, written_down = service.app.state.context.runner.lifecycle, threading.Event()
    fail = lifecycle.fail

    def fails_slowly(test_id: str, error: Exception) -> None:
        fail(test_id, error)
        assert written_down.wait(60)

    monkeypatch.setattr(lifecycle, "take_recording", fails)
    monkeypatch.setattr(lifecycle, "fail", fails_slowly)
    monkeypatch.setattr(runner, "ENDING_S", 60.0)
    first = run_test(client, participant)
    assert first["state"] == "failed" and client.get("/v1/rig").json()["holder"]["test_id"] == first["id"]
    threading.Timer(0.3, written_down.set).start()
    assert client.post("/v1/tests", json={"participant": participant}).status_code == 202
    assert written_down.is_set()


def test_what_has_ended_is_not_called_failed_by_what_goes_wrong_later(
    client: httpx.Client, service: Service, participant: str
) -> None:
    ended = run_test(client, participant)
    service.app.state.context.runner.lifecycle.fail(ended["id"], RuntimeError("late"))
    now = client.get(f"/v1/tests/{ended['id']}").json()
    assert (now["state"], now["reason"]) == ("completed", ended["reason"])


def test_a_start_that_fails_unexpectedly_is_stopped_and_leaves_nothing_open(
    service: Service, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = service.app.state.context.rig
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

"""What lies between two parts: a token read while it is revoked, a rig's nonsense, a start that is not written down."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.cli import stop_key
from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.people.auth import Auth, Scope
from stimrig.api.people.idle_lock import IdleLock
from stimrig.api.people.pace import Guesses
from stimrig.api.store import Store
from stimrig.api.store.hashes import digest
from tests.api.conftest import Service, let_go, wait_done
from tests.api.test_problems import problem


def test_a_token_that_is_read_while_it_is_revoked_is_not_valid_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every live channel looks once a second: one of the looks may be under way."""
    store, clock = Store(f"sqlite:///{tmp_path}/a.db"), Clock()
    auth = Auth(store, clock, Guesses(clock), IdleLock(store, clock, 0))
    text = auth.issue("bench", [Scope.READ_LIVE], "settings")
    get, was_read, is_revoked = store.get, threading.Event(), threading.Event()

    def slow(*asked: Any) -> Any:
        row = get(*asked)
        was_read.set()
        assert is_revoked.wait(20)
        return row

    monkeypatch.setattr(store, "get", slow)
    look = threading.Thread(target=auth.bearer, args=(text,))
    look.start()
    assert was_read.wait(20) and auth.revoke(digest(text)[:16], "settings")
    is_revoked.set()
    look.join(20)
    with pytest.raises(ApiError, match="revoked"):
        auth.bearer(text)
    store.close()


def test_a_stop_that_is_answered_with_nonsense_names_the_emergency_switch(
    client: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def nonsense(*_: Any) -> dict[str, Any]:
        return {"confirmed": "perhaps"}

    monkeypatch.setattr(service.rig, "_on_stop", nonsense)
    told = problem(client.post("/v1/stop", json={}), 503)
    assert told["detail"].startswith("Use the stimulator's own emergency switch now.")
    entries = client.get("/v1/audit").json()
    assert "stop failed" in str(entries), "it is in the audit trail, too"


def test_a_stop_whose_answer_is_no_answer_names_the_emergency_switch(client: httpx.Client, service: Service) -> None:
    answers = [b"", b"nonsense\n", b"5\n", b"x" * (33 * 1024 * 1024)]

    async def served(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.write(answers.pop())
        writer.close()

    door = service.rig.path.with_name(service.rig.path.name + ".stop")
    context = service.app.state.context
    path = context.rig.path

    async def serve() -> asyncio.Server:
        return await asyncio.start_unix_server(served, str(door))

    server = asyncio.run_coroutine_threadsafe(serve(), service.rig_thread.loop).result(10)
    context.rig.path = door
    try:
        while answers:
            told = problem(client.post("/v1/stop", json={}), 503)
            assert told["detail"].startswith("Use the stimulator's own emergency switch now."), answers
            assert "validation error" not in told["detail"]
    finally:
        context.rig.path = path
        service.rig_thread.loop.call_soon_threadsafe(server.close)


def test_a_start_that_cannot_be_written_down_plays_nothing_on(
    service: Service, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lifecycle = service.app.state.context.runner.lifecycle
    update = lifecycle.update

    def broken(test_id: str, **fields: Any) -> Any:
        if fields.get("state") == "running":
            raise OSError("the disk is full")
        return update(test_id, **fields)

    monkeypatch.setattr(lifecycle, "update", broken)
    service.rig.speed = 1.0
    with service.client(headers={"Connection": "close"}) as client:
        assert client.post("/v1/tests", json={"participant": participant}).status_code == 500
        assert service.rig.stopped_by == "service"
        (test,) = client.get("/v1/tests").json()
        assert wait_done(client, test["id"], 20)["state"] == "stopped"
        assert let_go(client)


def test_a_stop_key_whose_answer_is_nonsense_says_that_the_stop_is_not_confirmed(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def nonsense(*_: Any) -> dict[str, Any]:
        return {"confirmed": "perhaps"}

    async def running(*_: Any) -> dict[str, Any]:
        return {"state": "running"}

    monkeypatch.setattr(service.rig, "_on_stop", nonsense)
    monkeypatch.setattr(service.rig, "_on_status", running)
    assert stop_key.at_rig(service.rig.path)().startswith(stop_key.DOUBT)

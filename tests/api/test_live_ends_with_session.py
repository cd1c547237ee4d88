"""The live channel is open as long as its session or token is valid, and no longer; the others' stay open."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from stimrig.api.store.audit import digest
from stimrig.api.store.tables import PageSession, Token
from stimrig.api.web.routes import tests
from tests.api.conftest import PASSWORD, TOKEN, Service, person, shared_service

served = shared_service(speed=0.02, idle_min=10)


@pytest.fixture
def service(served: Service, monkeypatch: pytest.MonkeyPatch) -> Service:
    """Each channel looks five times a second whether it may go on; so fifteen frames are three looks."""
    monkeypatch.setattr(tests, "LOOK_S", 0.2)
    return served


@pytest.fixture(scope="module")
def test_id(served: Service) -> str:
    """A test that outlasts this module."""
    with served.client() as admin:
        admin.post("/v1/participants", json={"code": "P017"})
        return admin.post("/v1/tests", json={"participant": "P017"}).json()["id"]


@contextmanager
def watching(service: Service, test_id: str, headers: dict[str, str]) -> Iterator[ClientConnection]:
    with service.live(test_id, None, **headers) as socket:
        assert json.loads(socket.recv(20))["type"] == "history"
        yield socket


def cookie(http: httpx.Client) -> dict[str, str]:
    ((name, value),) = http.cookies.items()
    return {"Cookie": f"{name}={value}"}


def last(socket: ClientConnection, code: int = 4401) -> dict[str, Any]:
    """What it says until it is closed by the service with a code; the last of it."""
    message: dict[str, Any] = {}
    with pytest.raises(ConnectionClosed) as closed:
        for _ in range(400):  # frames of 20 s
            message = json.loads(socket.recv(20))
    assert closed.value.rcvd is not None and closed.value.rcvd.code == code
    return message


def goes_on(socket: ClientConnection) -> None:
    """All that has come, and a frame after it."""
    for _ in range(15):
        assert json.loads(socket.recv(20))["type"] in ("test", "live", "idle", "state")


def test_it_goes_on_whatever_is_sent_to_it(service: Service, test_id: str) -> None:
    with watching(service, test_id, {"Authorization": f"Bearer {TOKEN}"}) as socket:
        socket.send(b"\0")
        socket.send("stop")
        goes_on(socket)


def test_it_tells_nothing_to_whom_it_is_not_for(service: Service, test_id: str) -> None:
    """Nobody, an unknown token, a token of another scope, and a page of elsewhere with a person's cookie."""

    def said(**headers: str) -> tuple[str, int]:
        with service.live(test_id, None, **headers) as socket:
            first = json.loads(socket.recv(20))
            assert first["type"] == "problem", first
            assert last(socket, 4000 + first["problem"]["status"]) == {}, "nor anything after it"
            return first["problem"]["type"], first["problem"]["status"]

    with closing(person(service, "Ada")) as http:
        assert said(**cookie(http), Origin="https://elsewhere.example") == ("/problems/forbidden", 403)
        assert said() == ("/problems/unauthorized", 401)
        assert said(Authorization="Bearer nobody") == ("/problems/unauthorized", 401)
        reader = service.token("reader", "read-model", "run-test")
        assert said(Authorization=f"Bearer {reader}") == ("/problems/forbidden", 403)


def sign_out(http: httpx.Client, _service: Service) -> None:
    assert http.delete("/v1/sessions/current").status_code == 204


def new_password(_http: httpx.Client, service: Service) -> None:
    with service.client() as admin:
        assert admin.put("/v1/users/Grace/password", json={"password": PASSWORD}).status_code == 204


def removed(_http: httpx.Client, service: Service) -> None:
    with service.client() as admin:
        assert admin.delete("/v1/users/Grace").status_code == 204


def run_out(http: httpx.Client, service: Service) -> None:
    service.change(PageSession, digest(next(iter(http.cookies.values()))), expires_unix_s=1.0)


@pytest.mark.parametrize("how", [sign_out, run_out, new_password, removed])
def test_it_closes_with_its_session_and_with_no_other(
    service: Service, test_id: str, how: Callable[[httpx.Client, Service], None]
) -> None:
    with (
        closing(person(service, "Grace")) as hers,
        closing(person(service, "Ada")) as other,
        watching(service, test_id, cookie(hers)) as socket,
        watching(service, test_id, cookie(other)) as others,
    ):
        how(hers, service)
        said = last(socket)
        assert said["type"] == "problem" and said["problem"]["type"] == "/problems/unauthorized"
        goes_on(others)


@pytest.mark.parametrize("how", ["revoked", "expired", "scope"])
def test_it_closes_with_its_token_and_with_no_other(service: Service, test_id: str, how: str) -> None:
    text = service.token("bench", "read-live")
    with (
        watching(service, test_id, {"Authorization": f"Bearer {text}"}) as socket,
        watching(service, test_id, {"Authorization": f"Bearer {TOKEN}"}) as others,
        service.client() as admin,
    ):
        if how == "revoked":
            assert admin.delete(f"/v1/tokens/{digest(text)[:16]}").status_code == 204
        else:
            changed = {"expires_utc": "2020-01-01T00:00:00Z"} if how == "expired" else {"scopes": ["read-model"]}
            service.change(Token, digest(text), **changed)
        status = 403 if how == "scope" else 401
        assert last(socket, 4000 + status)["problem"]["status"] == status
        goes_on(others)


@pytest.mark.parametrize("turns", range(4))
def test_a_message_at_the_moment_of_closing_does_not_keep_the_channel_open(turns: int) -> None:
    async def closed() -> bool:
        queue: asyncio.Queue[dict[str, Any]] = asyncio.Queue()

        async def pump() -> None:
            while True:
                await tests._next(queue)

        task = asyncio.create_task(pump())
        await asyncio.sleep(0.01)
        queue.put_nowait({"type": "live"})
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        return bool((await asyncio.wait([task], timeout=5))[0])

    assert asyncio.run(closed())

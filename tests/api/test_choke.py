"""A stop has a way of its own: threads that all wait, a held database, a crowd at the door do not keep it out."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from stimrig.api.errors import ApiError
from stimrig.api.sessions.rig_client import line_of
from stimrig.api.web import middleware, server
from stimrig.rig.messages import Profile, SegmentPlan, TestPlan
from stimrig.rig.requests import LONGEST_LINE, PreviewRequest
from tests.api.conftest import Server, Service, soon
from tests.api.test_stop_right import stops_noted


def connect(url: str, words: bytes = b"") -> socket.socket:
    place = urlsplit(url)
    connection = socket.create_connection((place.hostname, place.port), timeout=60)
    with contextlib.suppress(OSError):
        connection.sendall(words)
    return connection


def closed(connection: socket.socket) -> bool:
    with contextlib.suppress(ConnectionResetError):
        return connection.recv(1) == b""
    return True


@pytest.fixture
def started(service: Service, client: httpx.Client, participant: str) -> Iterator[None]:
    service.rig.speed = 1.0
    assert client.post("/v1/tests", json={"participant": participant}).status_code == 202
    yield


def test_a_stop_is_answered_while_every_thread_waits_for_the_database(
    service: Service, client: httpx.Client, started: None
):
    store, codes = service.app.state.context.store, []

    def add(number: int) -> None:
        with service.client() as other:
            codes.append(other.post("/v1/participants", json={"code": f"W{number}"}).status_code)

    with ThreadPoolExecutor(80) as pool, store.write():
        for number in range(80):
            pool.submit(add, number)
        time.sleep(0.5)  # they are all on their way
        answer = client.post("/v1/stop", json={"reason": "choked"})
        assert codes == []
    assert answer.status_code == 200, answer.text
    assert codes == [201] * 80
    assert [entry["detail"]["reason"] for entry in soon(lambda: stops_noted(client))] == ["choked"]


@pytest.fixture
def patient_door(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who says nothing is let go for the crowd alone: on a busy machine its time would be over in the test."""
    monkeypatch.setattr(server, "protocol", partial(server.protocol, request_s=600.0))


@pytest.mark.usefixtures("patient_door")
def test_a_stop_gets_in_past_a_crowd_that_says_nothing(service: Service, client: httpx.Client, started: None):
    halves = (b"", b"POST /v1/stop HTTP/1.1\r\nHos", b"GET / HTTP/1.1\r\nX: " + b"x" * 4000)
    held = [connect(service.url, halves[number % 3]) for number in range(400)]
    with service.client() as newcomer:
        assert newcomer.post("/v1/stop", json={}).status_code == 200
    assert closed(held[0])  # silent for longest
    held[-2].settimeout(0.05)
    with pytest.raises(TimeoutError):
        held[-2].recv(1)
    for connection in held:
        connection.close()


def test_who_says_nothing_is_let_go_after_a_while(service: Service):
    with Server(service.app, http=server.protocol(request_s=2.0)) as url:
        first, second = connect(url), connect(url, b"GET /health HTTP/1.1\r\nHost: x\r\n\r\n")
        assert second.recv(12) == b"HTTP/1.1 200"
        with contextlib.suppress(ConnectionError):  # no TimeoutError: that would be a door kept open
            while second.recv(65536):
                second.sendall(b"x")  # half of the next request keeps no door open
        assert closed(first)


def test_a_pipelined_request_that_is_being_served_is_not_cut_off():
    async def app(scope: dict[str, Any], _receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            await asyncio.sleep(1.0 if scope["path"] == "/slow" else 0)
            await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"0")]})
            await send({"type": "http.response.body"})

    with Server(app, http=server.protocol(request_s=0.2)) as url:
        two = connect(url, b"".join(b"GET %s HTTP/1.1\r\nHost: x\r\n\r\n" % path for path in (b"/quick", b"/slow")))
        said = b""
        with contextlib.suppress(ConnectionResetError):
            while got := two.recv(65536):
                said += got
    assert said.count(b"HTTP/1.1 200") == 2, "and only then, after a silence, it is closed"


def test_a_body_that_does_not_come_is_not_waited_for(service: Service, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(middleware, "BODY_S", 0.2)
    head = "POST /v1/participants HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 10\r\n"
    connection = connect(service.url, f"{head}Authorization: Bearer x\r\n\r\n{{".encode())
    assert connection.recv(12) == b"HTTP/1.1 408"


def test_too_many_previews_at_once_are_refused_before_they_are_read(
    service: Service, client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(middleware, "MOST_PREVIEWS", 1)
    asked, go_on = threading.Event(), threading.Event()

    async def slow(_body: object) -> dict[str, Any]:
        asked.set()
        await asyncio.to_thread(go_on.wait, 120)
        return {"duration_s": 1.0}

    monkeypatch.setattr(service.app.state.context.runner, "preview", slow)
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(client.post, "/v1/preview", json={"participant": participant})
        assert asked.wait(60)
        with service.client() as other:
            refused = other.post("/v1/preview", json={"participant": participant})
            assert refused.status_code == 503
            assert refused.headers["retry-after"] == "1"
            assert refused.json()["type"] == "/problems/crowded"
            assert other.post("/v1/stop").status_code == 200
        go_on.set()
        assert first.result().status_code == 200


def test_what_the_rig_would_not_hear_out_is_not_sent():
    widths = SegmentPlan(name="x", sequence="widths", settings={"pulse_width_us": [0.1] * (LONGEST_LINE // 3)})
    plan = TestPlan(test_id="t", participant="P", profile=Profile(), segments=[widths])
    with pytest.raises(ApiError, match="too long"):
        line_of(PreviewRequest(plan=plan))

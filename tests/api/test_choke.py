"""A stop has a way of its own: threads that all wait, a held database, a crowd at the door do not keep it out."""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import hypothesis
import pytest
import schemathesis
from schemathesis.checks import CHECKS

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.people.auth import Auth, Scope
from stimrig.api.people.pace import Guesses
from stimrig.api.sessions import runner
from stimrig.api.sessions.rig_client import line_of
from stimrig.api.store import Store
from stimrig.api.store.audit import digest
from stimrig.api.web import middleware, server
from stimrig.rig.messages import Profile, SegmentPlan, TestPlan, stop_socket
from stimrig.rig.requests import LONGEST_LINE, PreviewRequest
from tests.api.conftest import TOKEN, Server, Service, let_go, shared_service, soon, wait_done
from tests.api.test_problems import problem
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
    store, codes = service.context.store, []

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


def test_too_many_previews_at_once_are_refused(
    service: Service, client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(runner, "MOST_PREVIEWS", 1)
    asked, go_on = threading.Event(), threading.Event()

    whole = service.context.runner._previewed

    async def slow(plan: TestPlan) -> dict[str, Any]:
        asked.set()
        await asyncio.to_thread(go_on.wait, 120)
        return await whole(plan)

    monkeypatch.setattr(service.context.runner, "_previewed", slow)
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


SEED = int(os.environ.get("STIMRIG_SEED", "20261120"))
EXAMPLES = int(os.environ.get("STIMRIG_EXAMPLES", "3"))
"""Of each operation; a hunt takes more."""
AUTHORIZED = {"Authorization": f"Bearer {TOKEN}"}
# A stop is open to any body by design; the controller's fetch and the page's form have their own tests.
CHECKED = ["not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance"]


abused = shared_service(speed=400.0)


def test_made_up_requests_meet_no_server_error(abused: Service) -> None:
    """Schemathesis over the OpenAPI document: every operation, a fixed seed, a bounded number of examples."""
    with abused.client() as client:
        client.post("/v1/participants", json={"code": "P017"})
        document = client.get("/openapi.json").json()
    schema = schemathesis.openapi.from_dict(document)
    schema.config.update(base_url=abused.url)
    tried: Counter[str] = Counter()
    failures: list[str] = []
    limits = hypothesis.settings(
        max_examples=EXAMPLES, deadline=None, database=None, derandomize=True,
        phases=[hypothesis.Phase.generate], suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip
    for result in schema.get_all_operations():
        operation = result.ok()

        @hypothesis.seed(SEED)
        @limits
        @hypothesis.given(case=operation.as_strategy())
        def attack(case: schemathesis.Case) -> None:
            answer = case.call(headers=AUTHORIZED, timeout=60)
            tried[case.operation.label] += 1
            try:
                case.validate_response(answer, checks=[CHECKS.get_one(name) for name in CHECKED])
            except schemathesis.core.failures.FailureGroup as group:
                failures.extend(f"{case.operation.label}: {failure}" for failure in group.exceptions)

        attack()
    assert failures == []
    assert len(tried) == sum(len(methods) for methods in document["paths"].values())


def test_fifty_starts_at_once_give_one_test_and_forty_nine_refusals(service: Service) -> None:
    service.rig.speed = 0.5  # it runs until all fifty are answered
    with service.client(limits=httpx.Limits(max_connections=50)) as client:
        client.post("/v1/participants", json={"code": "P017"})
        with ThreadPoolExecutor(50) as pool:
            answers = list(pool.map(lambda _: client.post("/v1/tests", json={"participant": "P017"}), range(50)))
        (winner,) = [answer.json()["id"] for answer in answers if answer.status_code == 202]
        refusals = [problem(answer, 409) for answer in answers if answer.status_code != 202]
        assert len(refusals) == 49
        assert all(each["holder"]["test_id"] == winner and winner in each["detail"] for each in refusals)
        assert service.rig.starts == 1
        assert [test["id"] for test in client.get("/v1/tests").json()] == [winner]


@pytest.mark.parametrize("path", ["/v1/participants/P017/recordings", "/v1/participants", "/v1/stop"])
def test_a_body_without_an_end_is_not_taken_in(service: Service, client: httpx.Client, path: str) -> None:
    """A client that never stops sending is cut off; the service answers others meanwhile."""
    service.context.settings.max_upload_mb = 1.0
    client.post("/v1/participants", json={"code": "P017"})
    seen = client.get("/v1/participants/P017").headers["etag"]
    head = f"POST {path} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {TOKEN}\r\nIf-Match: {seen}\r\n"
    head += "Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n"
    with connect(service.url, head.encode()) as line:
        with contextlib.suppress(OSError):  # it was cut off
            for _ in range(40):
                line.sendall(b"10000\r\n" + b"x" * 65536 + b"\r\n")
                if select.select([line], [], [], 0.01)[0]:
                    break
        answer = line.recv(4096)
    if path == "/v1/stop":
        assert answer.startswith(b"HTTP/1.1 200") and service.rig.stopped_by, "a stop is a stop"
    else:
        assert answer.startswith(b"HTTP/1.1 413") and b"application/problem+json" in answer, answer[:200]
    assert client.get("/health").status_code == 200
    assert not list((service.data / "recordings").rglob("upload-*"))


def test_a_token_that_is_read_while_it_is_revoked_is_not_valid_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every live channel looks once a second: one of the looks may be under way."""
    store, clock = Store(f"sqlite:///{tmp_path}/a.db"), Clock()
    auth = Auth(store, clock, Guesses(clock))
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


def test_a_stop_whose_answer_is_no_answer_names_the_emergency_switch(client: httpx.Client, service: Service) -> None:
    perhaps = b'{"id": 0, "ok": true, "body": {"confirmed": "perhaps"}}\n'
    answers = [b"", b"nonsense\n", b"5\n", perhaps, b"x" * (33 * 1024 * 1024)]

    async def served(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.write(answers.pop())
        writer.close()

    at_stops = asyncio.start_unix_server(served, str(stop_socket(service.rig.path)))
    server = asyncio.run_coroutine_threadsafe(at_stops, service.rig_thread.loop).result(10)
    while answers:
        told = problem(client.post("/v1/stop", json={}), 503)
        assert told["detail"].startswith("Use the stimulator's own emergency switch now."), answers
        assert "validation error" not in told["detail"]
    assert "stop failed" in str(client.get("/v1/audit").json()), "it is in the audit trail, too"
    figures = client.get("/metrics").text
    assert 'stimrig_stops_total{outcome="failed"} 5.0' in figures
    assert "stimrig_stop_confirmation_seconds_count 0.0" in figures, "a stop without an answer has no time"
    service.rig_thread.loop.call_soon_threadsafe(server.close)


def test_a_start_that_cannot_be_written_down_plays_nothing_on(
    service: Service, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lifecycle = service.context.runner.lifecycle
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

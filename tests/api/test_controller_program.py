"""examples/controller.c against answers that are wrong, and none: it stops what it began, and nothing else."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.harness.c_program import compiled

CODE, ODD_CODE = "P017", "P 1/../P2?x"
PLANNED = {"pulse_rate_hz": 50.0, "segments": [{"name": "trial"}], "unreachable": []}
BEGUN = {"id": "T1", "done": False, "state": "running"}
DONE = {**BEGUN, "done": True, "state": "completed", "reason": "", "recording_id": "R1"}


class Service:
    """A server with an answer for each method and path."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, Any]] = []
        self.polled = threading.Event()
        self.answers: dict[str, Any] = {  # status and JSON; status 0: the connection is closed without an answer
            "GET /model": (200, {"model_id": "M1"}),
            "POST /widths": (200, PLANNED),
            "POST /tests": (202, BEGUN),
            "GET /T1": (200, DONE),
            "GET /R1": (200, "file"),
            "POST /stop": (200, {"stopped": True}),
        }
        self.url = ""

    def __call__(self, request: httpx.Request) -> httpx.Response:
        path = request.url.raw_path.decode()
        self.heard.append((f"{request.method} {path}", json.loads(request.read() or "null")))
        if path.endswith("/T1"):
            self.polled.set()
        status, document = self.answers[f"{request.method} /{path.rsplit('/', 1)[1]}"]
        if not status:
            raise httpx.ReadError("closed")
        return httpx.Response(status, json=document)

    @property
    def stops(self) -> int:
        return [path for path, _ in self.heard].count("POST /v1/stop")


@contextmanager
def answering(answer: Callable[[httpx.Request], httpx.Response]) -> Iterator[str]:
    """Address of a server that answers one request after the other; a broken line closes the connection."""
    turn = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def answer(self) -> None:
            length = int(self.headers.get("Content-Length", 0))
            body = self.rfile.read(length)
            if len(body) < length:
                return  # whoever sent it was killed
            request = httpx.Request(self.command, f"http://here{self.path}", headers=dict(self.headers), content=body)
            try:
                with turn:
                    given = answer(request)
            except httpx.TransportError:
                self.close_connection = True
                return
            self.send_response(given.status_code)
            self.send_header("Content-Length", str(len(given.content)))
            self.end_headers()
            self.wfile.write(given.content)

        do_GET = do_POST = do_PUT = answer  # noqa: N815

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("c"))


@pytest.fixture
def service() -> Iterator[Service]:
    found = Service()
    with answering(found) as found.url:
        yield found


def begun(program: Path, service: Service, folder: Path, code: str = CODE) -> subprocess.Popen[str]:
    words = [str(program), service.url, code, str(folder / "trial.h5")]
    return subprocess.Popen(words, env={**os.environ, "STIMRIG_TOKEN": "key"}, stderr=subprocess.PIPE, text=True)


def ended(run: subprocess.Popen[str]) -> tuple[int, str]:
    said = run.communicate(timeout=60)[1]
    return run.returncode, said


def test_the_trial_has_the_rate_of_its_widths_and_the_code_is_escaped(program: Path, service: Service, tmp_path: Path):
    assert ended(begun(program, service, tmp_path, ODD_CODE)) == (0, "")
    paths, sent = [path for path, _ in service.heard], dict(service.heard)["POST /v1/tests"]
    assert paths[0] == "GET /v1/participants/P%201%2F..%2FP2%3Fx/model"
    assert sent == {
        "participant": ODD_CODE,
        "kind": "sequence",
        **{k: PLANNED[k] for k in ("segments", "pulse_rate_hz")},
    }
    assert service.stops == 0 and json.loads((tmp_path / "trial.h5").read_text()) == "file"


@pytest.mark.parametrize(
    ("asked", "answer", "stops"),
    [
        ("GET /model", (200, {}), 0),
        ("POST /widths", (200, {"segments": []}), 0),
        ("POST /widths", (200, {**PLANNED, "unreachable": [{}]}), 0),
        ("POST /tests", (409, {"detail": "The rig is in use."}), 0),
        ("POST /tests", (409, {}), 0),
        ("POST /tests", (0, None), 1),
        ("POST /tests", (202, {}), 1),
        ("GET /T1", (0, None), 1),
        ("GET /T1", (500, {}), 1),
        ("GET /T1", (200, {"done": True}), 0),
        ("GET /T1", (200, {"done": True, "state": "stopped"}), 0),
        ("GET /T1", (200, {**DONE, "recording_id": None}), 0),
        ("GET /R1", (404, {}), 0),
    ],
)
def test_what_goes_wrong_is_said_and_only_its_own_trial_is_stopped(
    program: Path, service: Service, tmp_path: Path, asked: str, answer: tuple[int, Any], stops: int
) -> None:
    service.answers[asked] = answer
    status, said = ended(begun(program, service, tmp_path))
    assert status == 1 and said.strip(), "it ends by itself, with words"
    assert service.stops == stops, said
    assert ("stop was pressed" in said) == bool(stops)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_whoever_interrupts_it_stops_the_trial(program: Path, service: Service, tmp_path: Path, number: signal.Signals):
    service.answers["GET /T1"] = (200, BEGUN)
    run = begun(program, service, tmp_path)
    assert service.polled.wait(60)
    run.send_signal(number)
    status, said = ended(run)
    assert status == 1 and service.stops == 1 and "stop was pressed" in said


def test_a_stop_that_is_not_confirmed_is_said_loudly(program: Path, service: Service, tmp_path: Path) -> None:
    service.answers |= {"GET /T1": (0, None), "POST /stop": (503, {})}
    assert "STOP WAS NOT CONFIRMED" in ended(begun(program, service, tmp_path))[1]

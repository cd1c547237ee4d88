"""examples/controller.c against answers that are wrong, and none: it stops what it began, and nothing else."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.harness.c_program import compiled

CODE, ODD_CODE = "P017", "P 1/../P2?x"
PLANNED = {"pulse_rate_hz": 50.0, "segments": [{"name": "trial"}], "unreachable": []}
BEGUN = {"id": "T1", "done": False, "state": "running"}
DONE = {**BEGUN, "done": True, "state": "completed", "reason": "", "recording_id": "R1"}


class Service(ThreadingHTTPServer):
    """A server with an answer for each method and the last part of the path."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.heard: list[tuple[str, Any]] = []
        self.polled, self.turn = threading.Event(), threading.Lock()
        self.answers: dict[str, Any] = {  # status and JSON; status 0: the connection is closed without an answer
            "GET /model": (200, {"model_id": "M1"}),
            "POST /widths": (200, PLANNED),
            "POST /tests": (202, BEGUN),
            "GET /T1": (200, DONE),
            "GET /R1": (200, "file"),
            "POST /stop": (200, {"stopped": True}),
        }

    @property
    def stops(self) -> int:
        return [path for path, _ in self.heard].count("POST /v1/stop")


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Service

    def answer(self) -> None:
        length = int(self.headers.get("Content-Length", 0))
        body = self.rfile.read(length)
        if len(body) < length:
            return  # whoever sent it was killed
        with self.server.turn:
            self.server.heard.append((f"{self.command} {self.path}", json.loads(body or b"null")))
        status, document = self.server.answers[f"{self.command} /{self.path.rsplit('/', 1)[1]}"]
        if self.path.endswith("/T1"):
            self.server.polled.set()
        if not status:
            self.close_connection = True
            return
        content = json.dumps(document).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    do_GET = do_POST = answer  # noqa: N815

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("c"))


@pytest.fixture
def service() -> Iterator[Service]:
    with Service() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def begun(program: Path, service: Service, folder: Path, code: str = CODE) -> subprocess.Popen[str]:
    words = [str(program), f"http://127.0.0.1:{service.server_port}", code, str(folder / "trial.h5")]
    return subprocess.Popen(words, env={**os.environ, "STIMRIG_TOKEN": "key"}, stderr=subprocess.PIPE, text=True)


def ended(run: subprocess.Popen[str]) -> tuple[int, str]:
    said = run.communicate(timeout=60)[1]
    return run.returncode, said


def test_the_trial_has_the_rate_of_its_widths_and_the_code_is_escaped(program: Path, service: Service, tmp_path: Path):
    assert ended(begun(program, service, tmp_path, ODD_CODE)) == (0, "")
    assert service.heard[0][0] == "GET /v1/participants/P%201%2F..%2FP2%3Fx/model"
    trial = {"participant": ODD_CODE, "kind": "sequence", "segments": PLANNED["segments"], "pulse_rate_hz": 50.0}
    assert dict(service.heard)["POST /v1/tests"] == trial
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

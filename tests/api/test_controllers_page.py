"""docs/controllers.md does what it says: its blocks are run in order, with a key; its C program compiles and plays."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.api.browser import bring_to_rest
from tests.api.conftest import REAL, Service, run_service, soon
from tests.api.test_jobs import made_up_csv
from tests.harness.c_program import compiled

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "controllers.md").read_text("utf-8")
PLAN = {"current_ma": 20.0, "max_pulse_width_us": 300.0, "max_duration_s": 30.0, "trials": 9}


def blocks(language: str, text: str = TEXT) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def weaker(record: Path, share: float) -> bytes:
    """The record of a muscle that has become stronger since: what there is to learn."""
    head, *rows = record.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    return "\n".join([head, *(",".join([a, b, str(share * float(c)), d]) for a, b, c, d in cells)]).encode()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[tuple[Service, str]]:
    """A service with an approved model of P017, and a key."""
    folder = tmp_path_factory.mktemp("controllers")
    for service in run_service(folder, short_dir, REAL):
        with service.client(timeout=120) as admin:
            admin.post("/v1/participants", json={"code": "P017"})
            approve(admin, weaker(made_up_csv(folder / "record.csv"), 0.87))
        yield service, key_of(service, "page")


def key_of(service: Service, name: str) -> str:
    with service.client() as admin:
        return admin.post("/v1/participants/P017/keys", json={"name": name, **PLAN}).json()["key"]


def approve(admin: httpx.Client, recording: bytes) -> None:
    model = admin.post("/v1/participants/P017/recordings", content=recording).json()["model"]["id"]
    assert admin.post(f"/v1/models/{model}/approve", json={"reason": "for the page's test"}).status_code == 200


@pytest.fixture(autouse=True)
def ready(request: pytest.FixtureRequest) -> None:
    """The page ends with a stop; a person would look and re-arm, once the test has ended."""
    if "served" in request.fixturenames:
        bring_to_rest(request.getfixturevalue("served")[0])


def environment(served: tuple[Service, str]) -> dict[str, str]:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    keys = {"KEY": served[1], "STIMRIG_TOKEN": served[1]}
    return {**os.environ, "PATH": path, "URL": served[0].url, "PYTHONPATH": str(ROOT), **keys}


def in_shell(served: tuple[Service, str], folder: Path, lines: list[str]) -> str:
    (folder / "examples").symlink_to(ROOT / "examples")
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", "\n".join(lines)], cwd=folder, env=environment(served), text=True,
        capture_output=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_every_line_for_the_shell_runs_in_order(served: tuple[Service, str], tmp_path: Path) -> None:
    shell = blocks("bash")
    assert len(shell) >= 8
    live = [block for block in shell if "live_torque" in block or "ten_minutes" in block]  # they have their own tests
    out = in_shell(served, tmp_path, [block for block in shell if block not in live])
    assert "304" in out and '"torque_nm"' in out and '"state":"completed"' in out.replace(" ", "")
    assert (tmp_path / "trial.h5").read_bytes().startswith(b"\x89HDF") and "fit_percent" in out


@pytest.mark.slow
def test_live_torque_comes_while_it_is_measured(served: tuple[Service, str], tmp_path: Path) -> None:
    first, *_ = blocks("bash")
    (live,) = [block for block in blocks("bash") if "live_torque" in block]
    in_shell(served, tmp_path, [first, live])
    head, *rows = (tmp_path / "live.csv").read_text().splitlines()
    assert head == "time_s,torque_min_nm,torque_max_nm"
    values = [[float(cell) for cell in row.split(",")] for row in rows]
    assert values[-1][0] > 3.0 and max(row[2] for row in values) > 0.2, "a ramp of 150 µs gives torque"
    assert all(low <= high for _, low, high in values)


PROGRAMS = {
    "ilc.py": ("python3", ""),
    "ilc.m": ("octave-cli", ""),
    "ilc.cpp": ("g++", "#include <curl/curl.h>\n#include <nlohmann/json.hpp>\n"),
}
"""What runs each program that learns, and the headers that it includes."""


def skip_without(program: str) -> None:
    tool, headers = PROGRAMS[program]
    if shutil.which(tool) is None:
        pytest.skip(f"not run: there is no {tool} (Debian: {'octave' if program == 'ilc.m' else tool})")
    command = ["g++", "-x", "c++", "-E", "-"]
    if headers and subprocess.run(command, input=headers, text=True, capture_output=True, check=False).returncode:
        pytest.skip("not compiled: libcurl4-openssl-dev and nlohmann-json3-dev are not installed")


def learner(served: tuple[Service, str], program: str) -> tuple[tuple[Service, str], list[str]]:
    """A key of its own, and the page's lines for a program."""
    skip_without(program)
    (lines,) = [block for block in blocks("bash") if f"ten_minutes/{program}" in block]
    return (served[0], key_of(served[0], program)), ["export URL KEY", lines]


@pytest.mark.slow
@pytest.mark.parametrize("program", PROGRAMS)
def test_each_program_learns(served: tuple[Service, str], tmp_path: Path, program: str) -> None:
    own, lines = learner(served, program)
    out = in_shell(own, tmp_path, lines)
    percent = [float(value) for value in re.findall(r"trial \d: ([\d.]+) %", out)]
    assert len(percent) == 6 and percent[0] > 10, out
    assert percent[-1] < percent[0] / 4, out
    assert served[0].rig.state == "ready", "nothing was stopped"


@pytest.mark.slow
def test_a_program_ends_where_a_person_has_to_look(served: tuple[Service, str], tmp_path: Path) -> None:
    """The muscle is twice as strong as its approved model: more than a person allowed."""
    service, _ = served
    with service.client(timeout=120) as admin:
        approve(admin, weaker(made_up_csv(tmp_path / "record.csv"), 0.5))
        own, _ = learner(served, "ilc.py")
        run = subprocess.run([sys.executable, "examples/ten_minutes/ilc.py"], cwd=ROOT, env=environment(own),
                             capture_output=True, text=True)  # fmt: skip
        approve(admin, weaker(made_up_csv(tmp_path / "again.csv"), 0.87))
    assert run.returncode == 1 and "a person has to look first" in run.stderr and "trial 6" not in run.stdout


LIVE = "python3 examples/live_torque.py --url $URL --participant P017"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("program", ["live_torque.py", *PROGRAMS])
def test_whoever_interrupts_a_program_stops_its_trial(
    served: tuple[Service, str], tmp_path: Path, program: str, number: signal.Signals
) -> None:
    if program == "ilc.m" and number == signal.SIGTERM:
        pytest.skip("Octave ends at once")
    service, own, script = served[0], served, [LIVE]
    if program in PROGRAMS:
        own, lines = learner(served, program)
        script = "\n".join(lines).splitlines()
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    service.rig.speed = 0.2
    try:
        subprocess.run(["bash", "-euc", "\n".join(script[:-1])], cwd=tmp_path, env=environment(own), check=True)
        words = shlex.split(script[-1].replace("$URL", service.url))
        with subprocess.Popen(words, cwd=tmp_path, env=environment(own), stderr=subprocess.PIPE, text=True) as run:
            soon(lambda: service.rig.state == "running")
            run.send_signal(number)
            _out, err = run.communicate(timeout=60)
        key = program if program in PROGRAMS else "page ("
        assert run.returncode != 0 and str(service.rig.stopped_by).startswith(key) and "Traceback" not in err
    finally:
        service.rig.speed = 12.0


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("c"))


@pytest.mark.slow
def test_the_c_program_plays_a_trial(program: Path, served: tuple[Service, str], tmp_path: Path) -> None:
    time.sleep(1.0)  # the rest between two tests
    out = tmp_path / "trial.h5"
    run = [str(program), served[0].url, "P017", str(out)]
    subprocess.run(run, env=environment(served), check=True, timeout=60)
    assert out.read_bytes().startswith(b"\x89HDF")
    wrong = subprocess.run(
        [*run[:2], "P018", str(out)], env=environment(served), capture_output=True, text=True, check=False
    )
    assert wrong.returncode == 1 and "This key is for one participant" in wrong.stderr


@pytest.mark.slow
def test_every_line_of_the_page_on_rest_runs(served: tuple[Service, str], tmp_path: Path) -> None:
    text = (ROOT / "docs" / "api.md").read_text("utf-8")
    shell = blocks("bash", text)
    assert shell and len(re.findall(r"^```.", text, re.MULTILINE)) == len(shell), "of no other kind"
    service, _ = served
    lines = [f"TOKEN={service.token('api.md', 'run-test', 'read-model')}", *shell]
    assert '"current_ma":18' in in_shell(served, tmp_path, lines).replace(" ", "")


# ---- examples/controller.c against answers that are wrong, and none: it stops what it began, and nothing else.


CODE, ODD_CODE = "P017", "P 1/../P2?x"
PLANNED = {"pulse_rate_hz": 50.0, "segments": [{"name": "trial"}], "unreachable": []}
BEGUN = {"id": "T1", "done": False, "state": "running"}
DONE = {**BEGUN, "done": True, "state": "completed", "reason": "", "recording_id": "R1"}


class Answers(ThreadingHTTPServer):
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
    server: Answers

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


@pytest.fixture
def service() -> Iterator[Answers]:
    with Answers() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def begun(program: Path, service: Answers, folder: Path, code: str = CODE) -> subprocess.Popen[str]:
    words = [str(program), f"http://127.0.0.1:{service.server_port}", code, str(folder / "trial.h5")]
    return subprocess.Popen(words, env={**os.environ, "STIMRIG_TOKEN": "key"}, stderr=subprocess.PIPE, text=True)


def ended(run: subprocess.Popen[str]) -> tuple[int, str]:
    said = run.communicate(timeout=60)[1]
    return run.returncode, said


def test_the_trial_has_the_rate_of_its_widths_and_the_code_is_escaped(program: Path, service: Answers, tmp_path: Path):
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
    program: Path, service: Answers, tmp_path: Path, asked: str, answer: tuple[int, Any], stops: int
) -> None:
    service.answers[asked] = answer
    status, said = ended(begun(program, service, tmp_path))
    assert status == 1 and said.strip(), "it ends by itself, with words"
    assert service.stops == stops, said
    assert ("stop was pressed" in said) == bool(stops)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_whoever_interrupts_it_stops_the_trial(program: Path, service: Answers, tmp_path: Path, number: signal.Signals):
    service.answers["GET /T1"] = (200, BEGUN)
    run = begun(program, service, tmp_path)
    assert service.polled.wait(60)
    run.send_signal(number)
    status, said = ended(run)
    assert status == 1 and service.stops == 1 and "stop was pressed" in said


def test_a_stop_that_is_not_confirmed_is_said_loudly(program: Path, service: Answers, tmp_path: Path) -> None:
    service.answers |= {"GET /T1": (0, None), "POST /stop": (503, {})}
    assert "STOP WAS NOT CONFIRMED" in ended(begun(program, service, tmp_path))[1]

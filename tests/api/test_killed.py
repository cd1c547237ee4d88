"""The service killed at any moment comes back with every record that it had acknowledged."""

from __future__ import annotations

import random
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.cli.supervisor import Child
from tests.api.conftest import TOKEN, soon, wait_done
from tests.harness.looks_first import LooksFirst
from tests.harness.processes import below

ROOT = Path(__file__).parents[2]
SEED = 61
AUTHORIZED = {"Authorization": f"Bearer {TOKEN}"}


@dataclass
class Acknowledged:
    """What the service has said it keeps."""

    participants: set[str] = field(default_factory=set)
    tests: set[str] = field(default_factory=set)
    uploads: dict[str, bytes] = field(default_factory=dict)
    decisions: dict[str, str] = field(default_factory=dict)
    approved: dict[str, str] = field(default_factory=dict)
    users: set[str] = field(default_factory=set)


@contextmanager
def fake_rig(folder: Path, socket: Path) -> Iterator[None]:
    command = [sys.executable, "-m", "tests.api.fake_rig", "--socket", str(socket), "--data", str(folder)]
    process = subprocess.Popen([*command, "--speed", "20"], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and "socket" in process.stdout.readline()
    try:
        yield
    finally:
        process.terminate()
        process.wait(10)
        process.stdout.close()


def service(folder: Path, socket: Path) -> Child:
    child = Child("api", [sys.executable, "-m", "tests.api.served"], folder / "api.log")
    child.environment = {
        "STIMRIG_DATA_DIR": str(folder), "STIMRIG_PORT": "0", "STIMRIG_ADMIN_TOKEN": TOKEN, "PYTHONPATH": str(ROOT),
        "STIMRIG_RIG_SOCKET": str(socket),
    }  # fmt: skip
    return child


def busy_clinic(url: str, seed: int, kept: Acknowledged, ended: threading.Event) -> None:
    """Deeds of all kinds, one after the other; what is answered is noted, what is cut off is not."""
    rng = random.Random(seed)
    with httpx.Client(base_url=url, auth=LooksFirst(TOKEN), timeout=60) as http:
        while not ended.is_set():
            try:
                action(http, rng, kept)
            except httpx.HTTPError:
                return


def action(http: httpx.Client, rng: random.Random, kept: Acknowledged) -> None:
    code = f"P{rng.randrange(10**9)}"
    if http.post("/v1/participants", json={"code": code}).status_code == 201:
        kept.participants.add(code)
    content = f"time_s,pulse_width_us,torque_nm,segment\n{rng.random()},0,0,rest\n".encode()
    made = http.post(f"/v1/participants/{code}/recordings", content=content)
    if made.status_code == 201:
        body = made.json()
        kept.uploads[body["recording_id"]] = content
        verb = rng.choice(["approve", "reject"])
        if http.post(f"/v1/models/{body['model']['id']}/{verb}", json={"reason": "x"}).status_code == 200:
            kept.decisions[body["model"]["id"]] = "approved" if verb == "approve" else "rejected"
            if verb == "approve":
                kept.approved[code] = body["model"]["id"]
    started = http.post("/v1/tests", json={"participant": code})
    if started.status_code == 202:
        kept.tests.add(started.json()["id"])
    user = f"u{rng.randrange(10**9)}"
    if http.post("/v1/users", json={"name": user, "password": "a long enough one"}).status_code == 201:
        kept.users.add(user)


def acknowledged(what: set[str], more_than: int) -> None:
    """Wait for it: on a busy machine there would be nothing to lose yet."""
    soon(lambda: len(what) > more_than, 120)


def everything_is_there(http: httpx.Client, kept: Acknowledged) -> None:
    assert {row["code"] for row in http.get("/v1/participants").json()} >= kept.participants
    assert {row["name"] for row in http.get("/v1/users").json()} >= kept.users
    for recording, content in kept.uploads.items():
        assert http.get(f"/v1/recordings/{recording}").content == content
    for model, decision in kept.decisions.items():
        assert http.get(f"/v1/models/{model}").json()["decision"] == decision
    for code, model in kept.approved.items():
        assert http.get(f"/v1/participants/{code}/model").json()["model_id"] == model
    for test in kept.tests:
        document: dict[str, Any] = wait_done(http, test)
        assert document["state"] in ("completed", "fault"), document
        if document["state"] == "completed":
            assert document["model_id"]
            assert http.get(document["recording_url"]).content.startswith(b"\x89HDF")
    assert http.get("/v1/audit").json()["whole"]


@pytest.mark.parametrize("kills", [1, pytest.param(3, marks=pytest.mark.campaign)])
def test_killed_at_any_moment_nothing_acknowledged_is_lost(tmp_path: Path, short_dir: Path, kills: int) -> None:
    socket, kept, moments = short_dir / f"k-{time.time_ns()}.sock", Acknowledged(), random.Random(SEED)
    with fake_rig(tmp_path, socket):
        for number in range(kills):
            child = service(tmp_path, socket)
            url = child.start()["url"]
            ended = threading.Event()
            clinic = threading.Thread(target=busy_clinic, args=(url, SEED + number, kept, ended))
            people, tests = len(kept.participants), len(kept.tests)
            clinic.start()
            acknowledged(kept.participants, people)
            if number < 2:
                acknowledged(kept.tests, tests)
            time.sleep(moments.uniform(0.3, 1.8))
            assert child.process is not None
            child.process.kill()
            child.process.wait()
            ended.set()
            clinic.join(90)
            assert not clinic.is_alive()
            child.end()
        child = service(tmp_path, socket)
        try:
            with httpx.Client(base_url=child.start()["url"], auth=LooksFirst(TOKEN), timeout=60) as http:
                everything_is_there(http, kept)
                assert child.process is not None
                for pid in below(child.process.pid):  # no process that reads uploads is told the token
                    assert TOKEN.encode() not in Path(f"/proc/{pid}/environ").read_bytes()
                assert len(kept.participants) >= kills and kept.tests, "there was something to lose"
        finally:
            child.end()

"""The service killed at any moment comes back with every record that it had acknowledged."""

from __future__ import annotations

import random
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest

from tests.api.conftest import TOKEN, soon, wait_done
from tests.api.fake_rig import RigThread
from tests.api.test_one_service import served
from tests.harness.looks_first import LooksFirst
from tests.harness.processes import below

SEED = 61


@dataclass
class Acknowledged:
    """What the service has said it keeps."""

    participants: set[str] = field(default_factory=set)
    tests: set[str] = field(default_factory=set)
    uploads: dict[str, bytes] = field(default_factory=dict)
    decisions: dict[str, str] = field(default_factory=dict)
    approved: dict[str, str] = field(default_factory=dict)
    users: set[str] = field(default_factory=set)


def client(url: str) -> httpx.Client:
    return httpx.Client(base_url=url, auth=LooksFirst(TOKEN), timeout=60)


def busy_clinic(url: str, seed: int, kept: Acknowledged) -> None:
    """Deeds of all kinds, one after the other, until the service is killed; what is answered is noted."""
    rng = random.Random(seed)
    with client(url) as http:
        while True:
            try:
                act(http, rng, kept)
            except httpx.HTTPError:
                return


def act(http: httpx.Client, rng: random.Random, kept: Acknowledged) -> None:
    code = f"P{rng.randrange(10**9)}"
    if http.post("/v1/participants", json={"code": code}).status_code == 201:
        kept.participants.add(code)
    content = f"time_s,pulse_width_us,torque_nm,segment\n{rng.random()},0,0,rest\n".encode()
    made = http.post(f"/v1/participants/{code}/recordings", content=content)
    if made.status_code == 201:
        kept.uploads[made.json()["recording_id"]] = content
        model, verb = made.json()["model"]["id"], rng.choice(["approve", "reject"])
        if http.post(f"/v1/models/{model}/{verb}", json={"reason": "x"}).status_code == 200:
            kept.decisions[model] = "approved" if verb == "approve" else "rejected"
            kept.approved |= {code: model} if verb == "approve" else {}
    started = http.post("/v1/tests", json={"participant": code})
    if started.status_code == 202:
        kept.tests.add(started.json()["id"])
    user = f"u{rng.randrange(10**9)}"
    if http.post("/v1/users", json={"name": user, "password": "a long enough one"}).status_code == 201:
        kept.users.add(user)


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
        document = wait_done(http, test)
        assert document["state"] in ("completed", "fault"), document
        if document["state"] == "completed":
            assert document["model_id"] and http.get(document["recording_url"]).content.startswith(b"\x89HDF")
    assert http.get("/v1/audit").json()["whole"]


@pytest.mark.parametrize("kills", [1, pytest.param(3, marks=pytest.mark.campaign)])
def test_killed_at_any_moment_nothing_acknowledged_is_lost(tmp_path: Path, short_dir: Path, kills: int) -> None:
    socket, kept, moments = short_dir / f"k-{time.time_ns()}.sock", Acknowledged(), random.Random(SEED)
    with RigThread(socket, tmp_path / "recordings", speed=20.0):
        for number in range(kills):
            people, tests = len(kept.participants), len(kept.tests)
            with served(tmp_path, RIG_SOCKET=str(socket)) as (process, url):
                clinic = threading.Thread(target=busy_clinic, args=(url, SEED + number, kept))
                clinic.start()
                soon(lambda more=people: len(kept.participants) > more, 120)  # else there is nothing to lose yet
                if number < 2:
                    soon(lambda more=tests: len(kept.tests) > more, 120)
                time.sleep(moments.uniform(0.1, 0.6))
                process.kill()
                clinic.join(90)
                assert not clinic.is_alive()
        with served(tmp_path, RIG_SOCKET=str(socket)) as (process, url), client(url) as http:
            everything_is_there(http, kept)
            for pid in below(process.pid):  # no process that reads uploads is told the token
                assert TOKEN.encode() not in Path(f"/proc/{pid}/environ").read_bytes()

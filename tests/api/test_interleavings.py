"""People, a controller and a service at odds: decisions that overtake each other, a busy database, late answers.

What may be decided on what is written here a second time, apart from `stimrig.api.store.seen`.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import Any

import httpx
import pytest

from stimrig.api.store.tables import AuditEntry, Model
from tests.api.conftest import Service, play_test
from tests.api.fake_rig import FakeRig
from tests.api.test_overtaken import TRIAL, key_of
from tests.harness.looks_first import LooksFirst

CODE = "P1"
HOME = f"/v1/participants/{CODE}"
OF_PERSON = ("create participant", "set profile", "set muscle", "archive", "unarchive", "finish calibration")
OF_MODELS = ("approve", "reject")


class Late(LooksFirst):
    """Looks, thinks for a while, and sometimes decides on what it saw long ago."""

    def __init__(self, random: Random) -> None:
        super().__init__()
        self.random = random
        self.old: dict[str, str] = {}

    def auth_flow(self, request: httpx.Request) -> Any:
        flow = super().auth_flow(request)
        answer = None
        with contextlib.suppress(StopIteration):
            while True:
                asked = next(flow) if answer is None else flow.send(answer)
                if asked is request and "if-match" in request.headers:
                    kept = self.old.setdefault(request.url.path, request.headers["if-match"])
                    if self.random.random() < 0.3:
                        request.headers["if-match"] = kept
                    self.old[request.url.path] = request.headers["if-match"]
                    time.sleep(self.random.random() ** 2 * 0.06)
                answer = yield asked


@dataclass
class Run:
    """What one run saw."""

    decided: int = 0
    begun: list[tuple[float, str]] = field(default_factory=list)
    """When the rig began a controller's trial (monotonic, s), and its id."""
    withdrawn: list[tuple[float, str]] = field(default_factory=list)
    changed: list[float] = field(default_factory=list)
    """When a change was answered that ends a controller's right."""
    wrong: list[str] = field(default_factory=list)


def one(service: Service, random: Random) -> Run:
    """Some people and a controller, each in a thread; then what the trail and the rig tell is judged."""
    run = Run()
    with service.client() as admin:
        model = play_test(admin, CODE)["model_id"]
        admin.post(f"/v1/models/{model}/approve", json={})
        child = admin.post(f"/v1/models/{model}/effects", json={"effects": ["fatigue"]}).json()["id"]
        key, controller = key_of(service, admin, CODE)
        listen(service.rig, run, Random(random.random()))
        people = [
            service.client(service.token(f"person {number}", "administer"), auth=Late(Random(random.random())))
            for number in range(random.randint(2, 4))
        ]
        work = [partial(person, http, Random(random.random()), run, [model, child], key) for http in people]
        work += [partial(controls, controller, Random(random.random()), run)]
        work += [partial(lock, service, Random(random.random()))]
        threads = [threading.Thread(target=each) for each in work]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(120)
            if thread.is_alive():
                run.wrong.append("somebody is still waiting after 120 s")
        for http in (*people, controller):
            http.close()
    judge(service, run)
    return run


def listen(rig: FakeRig, run: Run, random: Random) -> None:
    """Take down when the rig began something and when it was told to withdraw it; a start takes a while."""
    start, withdraw = rig._on_start, rig._on_withdraw

    async def begins(request: Any, writer: Any) -> Any:
        await asyncio.sleep(random.random() ** 2 * 0.5)
        answer = await start(request, writer)
        if request.plan.kind == "sequence":
            run.begun.append((time.monotonic(), request.plan.test_id))
        return answer

    async def takes_back(request: Any, writer: Any) -> Any:
        run.withdrawn.append((time.monotonic(), request.test_id))
        return await withdraw(request, writer)

    rig._on_start, rig._on_withdraw = begins, takes_back  # type: ignore[method-assign]


DECIDES = ("stop", "stop", "rearm", "rearm", "rearm", "rearm", "limits", "limits", "approve", "approve", "approve",
           "reject", "site", "revoke", "archive", "unarchive", "unarchive", "calibrate")  # fmt: skip


def person(http: httpx.Client, random: Random, run: Run, models: list[str], key: str) -> None:
    """Decides this and that."""
    time.sleep(random.random() * 0.5)  # a trial is asked for meanwhile
    for _ in range(random.randint(4, 8)):
        time.sleep(random.random() ** 2 * 0.05)
        what = random.choice(DECIDES)
        if what == "stop":
            answer = http.post("/v1/stop", json={"reason": "pain"})
            if answer.status_code != 200:
                run.wrong.append(f"a stop was refused: {answer.status_code} {answer.text[:200]}")
            continue
        answer = decide(http, what, random, random.choice(models), key)
        run.decided += answer.status_code < 400
        if what in ("approve", "reject", "revoke") and answer.status_code < 400:
            run.changed.append(time.monotonic())
        if answer.status_code >= 500 and answer.status_code != 503:
            run.wrong.append(f"{what}: {answer.status_code} {answer.text[:300]}")


def decide(http: httpx.Client, what: str, random: Random, model: str, key: str) -> httpx.Response:
    """One decision."""
    if what == "limits":
        return http.put(f"{HOME}/profile", json={"current_ma": float(random.randint(10, 20))})
    if what == "site":
        return http.put(f"{HOME}/muscle", json={"side": random.choice((None, "left"))})
    paths = {"rearm": "/v1/rearm", "approve": f"/v1/models/{model}/approve", "reject": f"/v1/models/{model}/reject",
             "revoke": f"/participants/{CODE}/keys/{key}/revoke", "calibrate": f"{HOME}/calibration"}  # fmt: skip
    body = {"approve": {}, "reject": {"reason": "not this one"}, "calibrate": {}}.get(what)
    return http.post(paths.get(what, f"{HOME}/{what}"), json=body)


def controls(http: httpx.Client, random: Random, run: Run) -> None:
    """Asks for trials, whatever comes of it."""
    for _ in range(random.randint(2, 5)):
        answer = http.post("/v1/tests", json={"participant": CODE, **TRIAL})
        if answer.status_code >= 500 and answer.status_code != 503:
            run.wrong.append(f"trial: {answer.status_code} {answer.text[:300]}")
        time.sleep(random.random() * 0.1)


def lock(service: Service, random: Random) -> None:
    """Have the database alone for a while, again and again."""
    for _ in range(random.randint(2, 5)):
        time.sleep(random.random() * 0.2)
        with service.context.store.write():
            time.sleep(random.random() ** 2 * 0.3)


def judge(service: Service, run: Run) -> None:
    """Hold every decision of the trail, and every trial of the rig, against what came before it."""
    store = service.context.store
    entries = [row.as_dict() for row in store.all(AuditEntry, order=AuditEntry.seq)]
    models = {row.id for row in store.all(Model)}
    for entry in entries:
        seen = str(entry["detail"].get("seen") or "").partition(".")[0]
        if not seen.isdecimal() or len(seen) > 10:
            continue
        between = [one for one in entries if int(seen) < one["seq"] < entry["seq"]]
        if entry["action"] in OF_PERSON or entry["action"] in ("begin calibration", "start test"):
            late = [one for one in between if one["subject"] == CODE and one["action"] in OF_PERSON]
        elif entry["action"] == "approve" or (entry["action"] == "reject" and _brings_back(entries, entry)):
            late = [one for one in between if one["subject"] in models and one["action"] in OF_MODELS]
        else:
            continue
        run.wrong += [f"{entry['action']} of {entry['who']} on {seen}, after {one['seq']} {one['action']}"
                      for one in late]  # fmt: skip
    for begun_s, test in run.begun:
        ended = [at_s for at_s in run.changed if at_s < begun_s - 1e-4]
        asked = next((one for one in entries if one["subject"] == test and one["action"] == "start test"), None)
        rights = [one for one in entries if one["action"] in (*OF_MODELS, "revoke token")
                  and asked is not None and one["seq"] > asked["seq"]]  # fmt: skip
        told = [at_s for at_s, withdrawn in run.withdrawn if withdrawn == test]
        if rights and not told and _answered(entries, asked) < len(ended):
            run.wrong.append(f"{test} was begun under a right that had been ended, and was not withdrawn")


def _brings_back(entries: list[dict[str, Any]], rejection: dict[str, Any]) -> bool:
    """Whether the model that it rejects was served, and another one is after it; else it only takes away."""
    before = [one for one in entries if one["seq"] < rejection["seq"]]

    def site(seq: int) -> Any:
        said = [one["detail"].get("side") for one in before if one["action"] == "set muscle" and one["seq"] < seq]
        return said[-1] if said else None

    gone, served = set[str](), list[str]()
    for one in reversed([one for one in before if one["action"] in OF_MODELS]):
        if one["action"] == "reject":
            gone.add(one["subject"])
        elif one["subject"] not in gone and site(one["seq"]) == site(rejection["seq"]):
            served.append(one["subject"])
    return served[:1] == [rejection["subject"]] and set(served) != {rejection["subject"]}


def _answered(entries: list[dict[str, Any]], asked: dict[str, Any] | None) -> int:
    """So many of the people's changes of rights stand in the trail before a trial's intent, the setup's aside."""
    before = asked["seq"] if asked else 0
    return sum(one["action"] in (*OF_MODELS, "revoke token") and one["seq"] < before for one in entries) - 1


SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(1, 300))]


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_is_decided_on_what_its_maker_has_not_seen(service: Service, seed: int) -> None:
    run = one(service, Random(seed))
    assert run.wrong == [] and run.decided > 0

"""A decision counts only for what the person saw: every door of tests/api/decisions.toml, and known attacks."""

from __future__ import annotations

import html
import re
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.routing import APIRoute

from stimrig.api.decisions import DECISIONS
from stimrig.api.web import pages, routes
from stimrig.api.web.app import routers
from tests.api.conftest import HTML, Service, run_test, shared_service, soon
from tests.api.fake_arm import still
from tests.api.test_profiles import mark_all

ROOT = Path(__file__).parents[2]
TABLE = tomllib.loads(Path(__file__).with_name("decisions.toml").read_text("utf-8"))
LIMITS = {"current_ma": 21.0, "max_pulse_width_us": 250.0, "max_torque_nm": 20.0}
KEY = {"name": "ilc", "current_ma": "8", "max_pulse_width_us": "200", "max_duration_s": "60", "trials": "3"}


# ---- the table --------------------------------------------------------------------------------------------------


def doors(kind: str) -> list[str]:
    return [door for row in TABLE[kind] for door in row["doors"]]


def test_every_route_and_button_that_changes_something_is_in_the_table_once() -> None:
    there = {
        f"{method} {route.path}"
        for router in routers(routes, pages)
        for route in router.routes
        if isinstance(route, APIRoute)
        for method in route.methods - {"GET", "HEAD"}
    }
    named = doors("decision") + doors("free")
    assert sorted(named) == sorted(set(named))
    said = "Say in tests/api/decisions.toml what must have been seen for it, or why nothing (CONTRIBUTING.md, a route)"
    assert set(named) == there, said


def test_what_the_table_calls_decisions_says_its_version_at_the_door() -> None:
    ours = {f"{one.method} {one.path}" for one in DECISIONS if one.path}
    ours |= {f"POST {one.form}" for one in DECISIONS if one.form}
    said = "api/decisions.py and tests/api/decisions.toml name the same decisions; CASES here says how each is tried"
    assert set(doors("decision")) == ours and {last_word(door) for door in ours} <= set(CASES), said
    for row in TABLE["decision"]:
        assert all((ROOT / place).is_file() for place in row["where"]), row


# ---- every door -------------------------------------------------------------------------------------------------


def last_word(door: str) -> str:
    """By which a case is known."""
    word = door.rpartition("/")[2]
    return {"{direction}": "up", "{threshold}": "sensory"}.get(word, word)


@dataclass
class World:
    """A service, its administrator, a colleague, and a participant with a model and its child, nothing decided."""

    service: Service
    me: httpx.Client
    colleague: httpx.Client
    code: str = "P1"
    names: dict[str, str] = field(default_factory=dict)

    @classmethod
    def made(cls, service: Service, code: str) -> World:
        me, colleague = service.client(), service.client(service.token("colleague", "administer"))
        world = cls(service, me, colleague, code, {"code": code})
        soon(lambda: service.rig.state != "running")
        if service.rig.state != "ready":
            assert me.post("/v1/rearm").is_success
        assert me.post("/v1/participants", json={"code": code}).is_success
        return world

    def model(self) -> str:
        first = self.names["parent_id"] = run_test(self.me, self.code)["model_id"]
        self.names["model_id"] = self.me.post(f"/v1/models/{first}/effects", json={"effects": ["fatigue"]}).json()["id"]
        return self.names["model_id"]

    def calibration(self) -> None:
        assert self.me.post(f"/v1/participants/{self.code}/calibration", json={}).is_success
        assert self.me.post(f"/v1/participants/{self.code}/calibration/step", json={"direction": "up"}).is_success

    def marked(self) -> None:
        assert self.me.post(f"/v1/participants/{self.code}/calibration", json={}).is_success
        mark_all(self.me, self.code)

    def lower(self) -> httpx.Response:
        return self.colleague.put(f"/v1/participants/{self.code}/profile", json={"current_ma": 9.0})

    def entries(self) -> list[dict[str, Any]]:
        return self.me.get("/v1/audit").json()["entries"]


@dataclass(frozen=True)
class Case:
    """How a door is made ready, what a colleague changes, and what is sent."""

    change: Callable[[World], Any]
    json: Any = None
    form: dict[str, str] = field(default_factory=dict)
    ready: Callable[[World], Any] = lambda _world: None
    page: str = "/participants/{code}"
    words: str = "colleague"
    """In what a person is told."""


def user(world: World) -> None:
    world.names["name"] = f"ada of {world.code}"
    added = {"name": world.names["name"], "password": "long enough", "scopes": ["read-live"]}
    assert world.me.post("/v1/users", json=added).is_success


def note(world: World) -> None:
    written = world.me.post(f"/v1/participants/{world.code}/notes", json={"kind": "other", "text": "x"})
    world.names["note_id"] = written.json()["id"]


def test_of(world: World) -> None:
    world.names["test_id"] = run_test(world.me, world.code)["id"]


test_of.__test__ = False  # type: ignore[attr-defined]


def stopped(world: World) -> Any:
    return world.colleague.post("/v1/stop", json={"reason": "pain"})


def another_train(world: World) -> Any:
    return world.colleague.post(f"/v1/participants/{world.code}/calibration/step", json={"direction": "up"})


def sensor(world: World) -> None:
    world.service.rig.arm.way = still(0.2)


def two_approved(world: World) -> Any:
    """The parent, then this one: rejecting it would bring the parent back."""
    models = world.names["parent_id"], world.names["model_id"]
    body = {"reason": "good enough for today"}
    return [world.colleague.post(f"/v1/models/{model}/approve", json=body) for model in models][-1]


PROFILE = Case(World.lower, LIMITS, {"current_ma": "21", "seen_current_ma": "20"})
MODEL = Case(
    lambda world: world.colleague.post(f"/v1/models/{world.names['model_id']}/reject", json={"reason": "wrong arm"}),
    {"reason": "good enough for today"}, {"reason": "good enough for today"}, World.model, "/models/{model_id}",
)  # fmt: skip
TRAIN = Case(
    another_train, {"direction": "up"}, {}, World.calibration, "/participants/{code}/calibration", "Another train"
)
ACCOUNT = Case(
    lambda world: world.colleague.put(f"/v1/users/{world.names['name']}/password", json={"password": "another one"}),
    {"password": "a third password"}, {"password": "a third password"}, user, "/administration",
)  # fmt: skip
CASES = {
    "rearm": Case(stopped, None, {}, stopped, "/", "stopped by colleague"),
    "approve": MODEL, "undo": MODEL,
    "reject": Case(two_approved, MODEL.json, MODEL.form, World.model, MODEL.page),
    "profile": PROFILE,
    "muscle": Case(World.lower, {"side": "left"}, {"side": "left"}),
    "archive": Case(World.lower), "unarchive": Case(World.lower),
    "recordings": Case(World.lower, "recording"),
    "tests": Case(World.lower, "participant", PROFILE.form),
    "calibration": Case(World.lower, {}, {"current_ma": "10", "step_us": "5"}),
    "step": TRAIN, "up": TRAIN, "sensory": TRAIN,
    "mark": Case(another_train, {"threshold": "sensory"}, {}, TRAIN.ready, TRAIN.page, TRAIN.words),
    "finish": Case(another_train, {"discard": False}, {}, World.marked, TRAIN.page, TRAIN.words),
    "discard": Case(
        lambda world: [
            world.colleague.post(f"/v1/participants/{world.code}/calibration/discard"),
            world.colleague.post(f"/v1/participants/{world.code}/calibration", json={}),
        ][-1], None, {}, TRAIN.ready, TRAIN.page, "colleague has begun another calibration"),
    "keys": Case(World.lower, {name: text if name == "name" else int(text) for name, text in KEY.items()}, KEY),
    "strike": Case(
        lambda world: world.colleague.post(f"/v1/participants/{world.code}/notes/{world.names['note_id']}/strike"),
        None, {}, note),
    "ran-by": Case(
        lambda world: world.colleague.put(f"/v1/tests/{world.names['test_id']}/ran-by", json={"ran_by": "Bea"}),
        {"ran_by": "Cem"}, {"ran_by": "Cem"}, test_of, "/tests/{test_id}"),
    "pose": Case(
        lambda world: world.colleague.post("/v1/rig/angle/pose", json={"angle_rad": 0.2}),
        {"angle_rad": 1.5}, {"angle_deg": "80"}, sensor, "/rig/angle"),
    "password": ACCOUNT,
}  # fmt: skip
shared = shared_service()


@pytest.fixture
def world(shared: Service, request: pytest.FixtureRequest) -> Iterator[World]:
    made = World.made(shared, f"P{abs(hash(request.node.name)) % 10**9}")
    yield made
    made.me.post(f"/v1/participants/{made.code}/calibration/discard")
    shared.rig.arm.way = None
    shared.rig.become(shared.rig.state, shared.rig.reason)


def told_on(world: World, path: str, field_name: str) -> str:
    """The version that a page carries in its forms."""
    answer = world.me.get(path, headers=HTML)
    assert answer.status_code == 200, answer.text
    return html.unescape(re.findall(rf'name="{field_name}" value="([^"]+)"', answer.text)[-1])


def table_of(world: World) -> bytes:
    """A recording that nobody else has."""
    rows = "".join(f"{k / 40},100,{world.code[1:]}e-9,prbs\n" for k in range(80))
    return f"time_s,pulse_width_us,torque_nm,segment\n{rows}".encode()


def sent(world: World, door: str, case: Case, version: str) -> httpx.Response:
    method, path = door.split()
    address = path.format(**world.names, direction="up", threshold="sensory")
    if path.startswith("/v1"):
        head = {"If-Match": version}
        if case.json == "recording":
            return world.me.request(method, address, content=table_of(world), headers=head)
        body = {"participant": world.code} if case.json == "participant" else case.json
        return world.me.request(method, address, json=body, headers=head)
    decision = next(one for one in DECISIONS if one.form == path)
    form, files = {**case.form, decision.field: version}, {}
    if case.json == "recording":
        files = {"files": {"file": ("a.csv", table_of(world))}}
    return world.me.post(address, data=form, headers=HTML, auth=None, **files)


def version_of(world: World, door: str, case: Case) -> str:
    method, path = door.split()
    if path.startswith("/v1"):
        document = next(one.document for one in DECISIONS if (one.method, one.path) == (method, path))
        return world.me.get(document.format(**world.names)).headers["etag"]
    decision = next(one for one in DECISIONS if one.form == path)
    return told_on(world, case.page.format(**world.names), decision.field)


@pytest.mark.parametrize("door", doors("decision"))
def test_what_was_changed_since_is_decided_anew(world: World, door: str) -> None:
    """A colleague is quicker: 409 says who and what, nothing is done; on what is there now it is done."""
    case = CASES[last_word(door)]
    case.ready(world)
    old = version_of(world, door, case)
    changed = case.change(world)
    assert changed.is_success, changed.text
    before = world.entries()
    refused = sent(world, door, case, old)
    assert refused.status_code == 409, refused.text
    assert case.words.lower() in html.unescape(refused.text).lower()
    since = [entry["action"] for entry in world.entries()[len(before) :]]
    assert since in ([], ["re-arm", "re-arm refused"]), "but for a re-arm's intent nothing was written"
    version = version_of(world, door, case)
    anew = sent(world, door, case, version)
    assert anew.status_code in (200, 201, 202, 204, 303), anew.text
    again = sent(world, door, case, version)
    assert again.status_code in (404, 409) or door in UNWRITTEN | TWICE, "its own entry is not among those looked at"
    assert world.entries()[-1]["seq"] > before[-1]["seq"] or door in UNWRITTEN


UNWRITTEN = {"POST /v1/participants/{code}/notes/{note_id}/strike", "POST /participants/{code}/notes/{note_id}/strike",
             "POST /v1/participants/{code}/unarchive", "POST /participants/{code}/unarchive",
             "POST /v1/participants/{code}/calibration/step", "POST /participants/{code}/calibration/step/{direction}",
             "POST /participants/{code}/profile", "POST /participants/{code}/tests"}  # fmt: skip
"""Done twice it changes nothing; a train is in the calibration's own recording; a jump is asked about first."""
TWICE = {"POST /v1/rearm", "POST /rearm", "POST /v1/models/{model_id}/reject", "POST /models/{model_id}/reject",
         "POST /v1/participants/{code}/recordings", "POST /participants/{code}/recordings",
         "POST /participants/{code}/keys", "POST /v1/participants/{code}/keys"}  # fmt: skip
"""A rig that is armed stays armed, what was rejected stays rejected; a recording and a key are added."""

"""A decision counts only for what its maker was shown: every route of tests/api/decisions.toml, and known attacks."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.routing import APIRoute

from stimrig.api.client.decisions import DECISIONS
from stimrig.api.web import routes
from stimrig.api.web.app import routers
from tests.api.conftest import Service, run_test, shared_service, soon
from tests.api.fake_arm import still
from tests.api.test_profiles import mark_all

TABLE = tomllib.loads(Path(__file__).with_name("decisions.toml").read_text("utf-8"))
LIMITS = {"current_ma": 21.0, "max_pulse_width_us": 250.0, "max_torque_nm": 20.0}
KEY = {"name": "ilc", "current_ma": 8, "max_pulse_width_us": 200, "max_duration_s": 60, "trials": 3}


def test_every_route_that_changes_something_is_in_the_table_once() -> None:
    there = {
        f"{method} {route.path}"
        for router in routers(routes)
        for route in router.routes
        if isinstance(route, APIRoute)
        for method in route.methods - {"GET", "HEAD"}
    }
    said = "Say in tests/api/decisions.toml on what it is decided, or why on nothing (CONTRIBUTING.md, a route)"
    assert sorted([*TABLE["decision"], *TABLE["free"]]) == sorted(there), said


def test_what_the_table_calls_decisions_asks_for_a_version(shared: Service) -> None:
    paths = shared.app.openapi()["paths"]
    asks = {
        f"{method.upper()} {path}"
        for path, methods in paths.items()
        for method, operation in methods.items()
        if any(header["name"] == "if-match" for header in operation.get("parameters", []))
    }
    assert set(TABLE["decision"]) == asks == set(DECISIONS)


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

    def model(self) -> None:
        first = self.names["parent_id"] = run_test(self.me, self.code)["model_id"]
        self.names["model_id"] = self.me.post(f"/v1/models/{first}/effects", json={"effects": ["fatigue"]}).json()["id"]

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
    """How a route is made ready, what a colleague changes, and what is sent."""

    change: Callable[[World], Any]
    json: Any = None
    ready: Callable[[World], Any] = lambda _world: None
    words: str = "colleague"
    """In what a person is told."""


def user(world: World) -> None:
    world.names["name"] = f"ada of {world.code}"
    added = {"name": world.names["name"], "password": "long enough", "scopes": ["read-live"]}
    assert world.me.post("/v1/users", json=added).is_success


def stopped(world: World) -> Any:
    return world.colleague.post("/v1/stop", json={"reason": "pain"})


def another_train(world: World) -> Any:
    return world.colleague.post(f"/v1/participants/{world.code}/calibration/step", json={"direction": "up"})


def another_calibration(world: World) -> Any:
    at = f"/v1/participants/{world.code}/calibration"
    return [world.colleague.post(f"{at}/discard"), world.colleague.post(at, json={})][-1]


def sensor(world: World) -> None:
    world.service.rig.arm.way = still(0.2)


def two_approved(world: World) -> Any:
    """The parent, then this one: rejecting it would bring the parent back."""
    models = world.names["parent_id"], world.names["model_id"]
    body = {"reason": "good enough for today"}
    return [world.colleague.post(f"/v1/models/{model}/approve", json=body) for model in models][-1]


MODEL = Case(
    lambda world: world.colleague.post(f"/v1/models/{world.names['model_id']}/reject", json={"reason": "wrong arm"}),
    {"reason": "good enough for today"}, World.model,
)  # fmt: skip
CASES = {
    "rearm": Case(stopped, None, stopped, "stopped by colleague"),
    "approve": MODEL,
    "reject": Case(two_approved, MODEL.json, World.model),
    "profile": Case(World.lower, LIMITS),
    "muscle": Case(World.lower, {"side": "left"}),
    "recordings": Case(World.lower, "recording"),
    "tests": Case(World.lower, "participant"),
    "calibration": Case(World.lower, {}),
    "step": Case(another_train, {"direction": "up"}, World.calibration, "Another train"),
    "mark": Case(another_train, {"threshold": "sensory"}, World.calibration, "Another train"),
    "finish": Case(another_train, None, World.marked, "Another train"),
    "discard": Case(another_calibration, None, World.calibration, "colleague has begun another calibration"),
    "keys": Case(World.lower, KEY),
    "pose": Case(
        lambda world: world.colleague.post("/v1/rig/angle/pose", json={"angle_rad": 0.2}), {"angle_rad": 1.5}, sensor),
    "password": Case(
        lambda world: world.colleague.put(f"/v1/users/{world.names['name']}/password", json={"password": "their word"}),
        {"password": "a third password"}, user),
}  # fmt: skip
shared = shared_service()


@pytest.fixture
def world(shared: Service, request: pytest.FixtureRequest) -> Iterator[World]:
    made = World.made(shared, f"P{abs(hash(request.node.name)) % 10**9}")
    yield made
    made.me.post(f"/v1/participants/{made.code}/calibration/discard")
    shared.rig.arm.way = None
    shared.rig.become(shared.rig.state, shared.rig.reason)


def sent(world: World, door: str, case: Case, version: str) -> httpx.Response:
    method, path = door.split()
    if case.json == "recording":  # one that nobody else has
        rows = "".join(f"{k / 40},100,{world.code[1:]}e-9,prbs\n" for k in range(80))
        more: dict[str, Any] = {"content": f"time_s,pulse_width_us,torque_nm,segment\n{rows}".encode()}
    else:
        more = {"json": {"participant": world.code} if case.json == "participant" else case.json}
    return world.me.request(method, path.format(**world.names), headers={"If-Match": version}, **more)


def version_of(world: World, door: str) -> str:
    document = DECISIONS[door]
    answer = world.me.get(document.format(**world.names))
    if document == "/v1/users":
        return next(f'"{one["version"]}"' for one in answer.json() if one["name"] == world.names["name"])
    return answer.headers["etag"]


@pytest.mark.parametrize("door", TABLE["decision"])
def test_what_was_changed_since_is_decided_anew(world: World, door: str) -> None:
    """A colleague is quicker: 412 says who and what, nothing is done; on what is there now it is done."""
    case = CASES[door.rpartition("/")[2]]
    case.ready(world)
    old = version_of(world, door)
    changed = case.change(world)
    assert changed.is_success, changed.text
    before = world.entries()
    refused = sent(world, door, case, old)
    assert refused.status_code == 412, refused.text
    assert case.words.lower() in refused.text.lower()
    since = [entry["action"] for entry in world.entries()[len(before) :]]
    assert since in ([], ["re-arm", "re-arm refused"]), "but for a re-arm's intent nothing was written"
    version = version_of(world, door)
    if changes := refused.json().get("changes"):
        assert refused.headers["etag"] == version and changes[-1]["new"]
        assert changes[-1]["old"] != changes[-1]["new"] or door == "POST /v1/rearm"
    anew = sent(world, door, case, version)
    assert anew.status_code in (200, 201, 202, 204), anew.text
    assert anew.headers.get("etag") != version or door in TWICE, "one's own decision has led to another version"
    again = sent(world, door, case, version)
    assert again.status_code in (404, 409, 412) or door in TWICE
    assert world.entries()[-1]["seq"] > before[-1]["seq"] or door in UNWRITTEN


UNWRITTEN = {"POST /v1/participants/{code}/calibration/step"}
"""A train is in the calibration's own recording."""
TWICE = {"POST /v1/rearm", "POST /v1/models/{model_id}/reject", "POST /v1/participants/{code}/recordings",
         *UNWRITTEN}  # fmt: skip
"""A rig that is armed stays armed, what was rejected stays rejected; a recording is added."""

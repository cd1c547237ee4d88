"""What the buttons of all pages call: REST routes that are there, with fields that they take, on a version."""

from __future__ import annotations

import re
from typing import Any

import pytest

from stimrig.api.client.decisions import document_of
from tests.api.conftest import HTML, Service, play_test, shared_service
from tests.api.fake_arm import still
from tests.api.forms import Control, Form, Page
from tests.api.test_profiles import calibrate
from tests.api.test_verdict import make_poor

service = shared_service()


@pytest.fixture(scope="module")
def addresses(service: Service) -> list[str]:
    """Pages of a database with something of everything."""
    service.rig.arm.way = still(1.0)
    with service.client() as client:
        client.post("/v1/participants", json={"code": "P017"})
        calibrate(client)
        test = play_test(client, "P017")
        model = test["model_id"]
        client.post(f"/v1/models/{model}/approve", json={})
        key = {"name": "ilc", "current_ma": 8, "max_pulse_width_us": 10, "max_duration_s": 60, "trials": 3}
        client.post("/v1/participants/P017/keys", json=key)
        client.post("/v1/participants/P017/notes", json={"kind": "spasm", "text": "left"})
        play_test(client, "P018")
        client.post("/v1/participants", json={"code": "P019"})
        client.put("/v1/participants/P019/archived", json={"archived": True})
        client.post("/v1/users", json={"name": "Ada", "password": "correct horse battery"})
        client.post("/v1/participants/P018/calibration")
    return [
        "/", "/participants/P017", "/participants/P018", "/participants/P017/calibration",
        "/participants/P018/calibration", "/participants/P017/joint", "/rig/angle", f"/tests/{test['id']}",
        f"/models/{model}", f"/models/{make_poor(service, model)}", "/participants/P019", "/administration",
    ]  # fmt: skip


def schema_of(document: dict[str, Any], call: str) -> tuple[dict[str, Any], set[str]] | None:
    """The body's properties and the query's names of a REST route; None where there is none."""
    method, _, address = call.partition(" ")
    address = re.sub(r"\{[\w.]+\}", "x", address.partition("?")[0])
    for path, routes in document["paths"].items():
        if re.fullmatch(re.sub(r"\{\w+\}", "[^/]+", path), address) and method.lower() in routes:
            route = routes[method.lower()]
            content = route.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
            query = {each["name"] for each in route.get("parameters", []) if each["in"] == "query"}
            return resolve(document, content), query
    return None


def resolve(document: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in schema or "anyOf" in schema:
        schema = next((each for each in schema["anyOf"] if "$ref" in each), {}) if "anyOf" in schema else schema
        if "$ref" not in schema:
            return {}
        schema = document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return schema.get("properties", {})


def unknown_fields(document: dict[str, Any], form: Form, button: Control | None, call: str) -> list[str]:
    found = schema_of(document, call)
    assert found is not None, f"there is no {call}"
    properties, query = found
    wrong = [name for name in re.findall(r"[?&](\w+)=", call) if name not in query]
    by_file = any(field.kind == "file" for field in form.fields)
    for control in [*form.fields, *([button] if button and button.name else [])]:
        given = control.attributes
        if not control.name or control.kind == "file" or "data-query" in given or "data-confirm" in given:
            continue
        level = {name: {} for name in query} if by_file else properties
        for part in control.name.split("."):
            if part not in level:
                wrong.append(control.name)
                break
            level = resolve(document, level[part])
    return wrong


def test_every_button_calls_a_route_with_its_fields_and_on_a_version(service: Service, addresses: list[str]) -> None:
    document = service.app.openapi()
    wrong, calls = [], set()
    with service.client(headers=HTML) as client:
        for address in addresses:
            answer = client.get(address)
            assert answer.status_code == 200, (address, answer.status_code)
            for form in Page(answer.text).forms:
                for call, given, button in form.calls():
                    method, _, path = call.partition(" ")
                    calls.add(f"{method} {re.sub(r'[?].*', '', path)}")
                    wrong += [(address, call, name) for name in unknown_fields(document, form, button, call)]
                    if document_of(method, path, {"participant": "P1"}) and not given.get("data-if-match"):
                        wrong.append((address, call, "no data-if-match"))
    assert not wrong and calls

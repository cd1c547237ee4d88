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
        client.post("/v1/users", json={"name": "Ada", "password": "correct horse battery"})
        client.post("/v1/participants/P018/calibration")
    return [
        "/", "/participants/P017", "/participants/P018", "/participants/P017/calibration",
        "/participants/P018/calibration", "/participants/P017/joint", "/rig/angle", f"/tests/{test['id']}",
        f"/models/{model}", f"/models/{make_poor(service, model)}", "/participants/P019", "/administration",
    ]  # fmt: skip


def properties(document: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """Return the properties of a schema, or of the one it refers to."""
    for each in (schema, *schema.get("anyOf", ())):
        if "$ref" in each:
            return document["components"]["schemas"][each["$ref"].rpartition("/")[2]]["properties"]
    return schema.get("properties", {})


def unknown_fields(document: dict[str, Any], form: Form, button: Control | None, call: str) -> list[str]:
    """List the fields and query names that the REST route of a call does not take."""
    method, _, address = call.partition(" ")
    address, _, query = re.sub(r"\{[\w.]+\}", "x", address).partition("?")
    (path,) = (path for path in document["paths"] if re.fullmatch(re.sub(r"\{\w+\}", "[^/]+", path), address))
    route = document["paths"][path][method.lower()]
    names = {each["name"]: {} for each in route.get("parameters", []) if each["in"] == "query"}
    content = route.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
    body = names if any(field.kind == "file" for field in form.fields) else properties(document, content)
    wrong = [name for name in re.findall(r"(\w+)=", query) if name not in names]
    for control in [*form.fields, *([button] if button else [])]:
        skipped = control.kind == "file" or {"data-query", "data-confirm"} & set(control.attributes)
        level = {control.name: {}} if skipped else body
        for part in control.name.split(".") if control.name else ():
            wrong += [control.name] if part not in level else []
            level = properties(document, level.get(part, {}))
    return wrong


def test_every_button_calls_a_route_with_its_fields_and_on_a_version(service: Service, addresses: list[str]) -> None:
    document = service.app.openapi()
    with service.client(headers=HTML) as client:
        for address in addresses:
            answer = client.get(address)
            assert answer.status_code == 200, (address, answer.status_code)
            calls = [(form, *each) for form in Page(answer.text).forms for each in form.calls()]
            assert calls, address
            for form, call, given, button in calls:
                assert not unknown_fields(document, form, button, call), (address, call)
                method, _, path = call.partition(" ")
                decides = document_of(method, path, {"participant": "P1"})
                assert not decides or given.get("data-if-match"), (address, call, "names no version")

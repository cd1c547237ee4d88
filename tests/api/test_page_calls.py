"""What the buttons of all pages call: REST routes that are there, with fields that they take, on a version."""

from __future__ import annotations

import re
from typing import Any

import pytest
from fastapi.routing import APIRoute

from stimrig.api.client.decisions import document_of
from stimrig.api.web import pages
from stimrig.api.web.app import routers
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


# ---- The two forms that work without scripts, sign-in and stop: whatever is posted to them is a problem in words.


FORM, PARTS = "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"


def part(name: str, value: bytes, more: str = "") -> bytes:
    head = f'--x\r\nContent-Disposition: form-data; name="{name}"{more}\r\n\r\n'
    return head.encode() + value + b"\r\n--x--\r\n"


BODIES: list[tuple[str, bytes]] = [
    ("", b""), (FORM, b""), (PARTS, b""), ("multipart/form-data", b"x"), ("application/json", b"{}"),
    ("application/json", b"[1]"), ("text/plain", b"x"), (FORM, b"&&==&%zz=%"), (FORM, b"\xff=\xfe"),
    (FORM, b"a=1&" * 2000), (PARTS, part("name", b"\xff\xfe")), (PARTS, part("name", b"x", '; filename="x.csv"')),
    *((f"{PARTS}; charset={charset}", part("name", b"+2AA-")) for charset in ("none", "idna", "utf-7", "punycode")),
    (f"{FORM}; charset=utf-7", b"name=%ff"), (FORM, b"name=%00&password=%00"), (FORM, b"token=%d7%ff%ef%bb%bf"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "answers"), [("/v1/sessions", {400, 401, 429}), ("/v1/stop", {200})])
def test_an_odd_form_is_a_problem_in_words_and_a_stop_is_a_stop(
    service: Service, path: str, answers: set[int]
) -> None:  # fmt: skip
    with service.client(None if path == "/v1/sessions" else "administrator-token-of-the-tests", headers=HTML) as client:
        for kind, body in BODIES:
            answer = client.post(path, content=body, headers={"content-type": kind}, follow_redirects=True)
            assert answer.status_code in answers, (kind, body[:60], answer.status_code)
            assert "<h1>" in answer.text


def test_a_form_is_utf_8(service: Service) -> None:
    with service.client(None, headers=HTML) as client:
        kind = f"{PARTS}; charset=utf-7"
        answer = client.post("/v1/sessions", content=part("name", b"+2AA-"), headers={"content-type": kind})
        assert answer.status_code == 400 and "UTF-8" in answer.text
        token = part("token", b"administrator-token-of-the-tests")
        answer = client.post("/v1/sessions", content=token, headers={"content-type": f'{PARTS}; charset="UTF-8"'})
        assert answer.status_code in (303, 429), answer.text


def test_pages_only_read_and_are_few() -> None:
    found = [route for router in routers(pages) for route in router.routes if isinstance(route, APIRoute)]
    assert not [route.path for route in found if route.methods != {"GET"}]
    assert len(found) <= 30

"""The OpenAPI document is enough to write a client with: what is sent, what comes back, who may, what can go wrong."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import httpx
import jsonschema_rs
import pytest

from stimrig.api.web.responses.rig import SequencesOut
from stimrig.rig import plan
from stimrig.rig.limits import HARD_LIMITS
from tests.api.conftest import Service, run_test, shared_service

OPEN = {"/health", "/metrics", "/v1/sessions"}
FREE_FORM = {"JsonValue"}
"""What is made to hold anything; each says so."""


service = shared_service()


@pytest.fixture(scope="module")
def document(service: Service) -> dict[str, Any]:
    return httpx.get(f"{service.url}/openapi.json", timeout=60).json()


def operations(document: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            yield path, method, operation


def bare(schema: dict[str, Any], place: str) -> Iterator[str]:
    """Places where a schema says nothing of what is there."""
    if not set(schema) - {"title", "description", "default", "examples"}:
        yield f"{place}: anything"
    unnamed = schema.get("additionalProperties", True) is True and not set(schema) & {"properties", "anyOf", "allOf"}
    if schema.get("type") == "object" and unnamed:
        yield f"{place}: an object without keys"
    if schema.get("type") == "array" and not {"items", "prefixItems"} & set(schema):
        yield f"{place}: a list of anything"
    for name, part in schema.get("properties", {}).items():
        yield from bare(part, f"{place}.{name}")
    for key in ("items", "additionalProperties"):
        if isinstance(schema.get(key), dict):
            yield from bare(schema[key], f"{place}[]")
    for part in [part for key in ("anyOf", "oneOf", "allOf") for part in schema.get(key, [])]:
        yield from bare(part, place)


def test_no_body_and_no_answer_is_a_bare_object(document: dict[str, Any]) -> None:
    found = [
        place
        for name, schema in document["components"]["schemas"].items()
        if name not in FREE_FORM
        for place in bare(schema, name)
    ]
    for path, method, operation in operations(document):
        bodies = [operation.get("requestBody", {}), *operation["responses"].values()]
        for kind, media in [pair for body in bodies for pair in body.get("content", {}).items()]:
            found += list(bare(media.get("schema", {}), f"{method} {path} {kind}"))
        done = [code for code in operation["responses"] if code.startswith("2") and code != "204"]
        found += [
            f"{method} {path} {code}: nothing" for code in done if not operation["responses"][code].get("content")
        ]
    assert found == []


def test_every_operation_says_who_may_and_every_error_is_a_problem(document: dict[str, Any]) -> None:
    assert document["components"]["securitySchemes"]["token"] == {
        "type": "http", "scheme": "bearer", "description": "a token, or a controller's key"
    }  # fmt: skip
    for path, method, operation in operations(document):
        assert bool(operation.get("security")) == (path not in OPEN), (method, path)
        assert "requestBody" not in operation or "400" in operation["responses"], (method, path)
        for code, answer in operation["responses"].items():
            if code >= "400":
                schema = answer["content"]["application/problem+json"]["schema"]
                assert schema == {"$ref": "#/components/schemas/Problem"}, (method, path, code)
        asks = bool(operation.get("security")) or path == "/v1/sessions"
        assert ("429" in operation["responses"]) == asks, (method, path)
        assert not asks or set(operation["responses"]["429"]["headers"]) == {"Retry-After"}, (method, path)
    approve = document["paths"]["/v1/models/{model_id}/approve"]["post"]
    assert {"token": ["approve-model"]} in approve["security"]
    assert approve["description"].endswith("Scope: `approve-model`.")


def test_real_answers_hold_to_the_document(
    client: httpx.Client, document: dict[str, Any], service: Service
) -> None:  # fmt: skip
    client.post("/v1/participants", json={"code": "P017"}).raise_for_status()
    test = run_test(client, "P017")
    ids = {"code": "P017", "test_id": test["id"], "model_id": test["model_id"], "name": "model"}
    client.post(f"/v1/models/{test['model_id']}/approve", json={"reason": "good"}).raise_for_status()
    client.post("/v1/users", json={"name": "Ada", "password": "long enough"}).raise_for_status()
    with service.client(token=None) as browser:
        browser.post("/v1/sessions", json={"name": "Ada", "password": "long enough"}).raise_for_status()
        assert list(browser.cookies) == [document["components"]["securitySchemes"]["session"]["name"]]
    tried = 0
    for path, method, operation in operations(document):
        kinds = operation["responses"].get("200", {}).get("content", {})
        if method != "get" or not any("json" in kind for kind in kinds) or "{job_id}" in path:
            continue
        if path.endswith(("/calibration", "/model", "/file", "/comparison", "/diagnosis", "{model_id}")):
            continue  # none is open; and a stub's are none: real ones in tests/api/test_schemas.py and test_why.py
        answer = client.get(path.format(**ids))
        assert answer.status_code == 200, (path, answer.text)
        (media,) = kinds.values()
        schema = {**media["schema"], "components": document["components"]}
        errors = [error.message for error in jsonschema_rs.Draft202012Validator(schema).iter_errors(answer.json())]
        assert errors == [], path
        tried += 1
    assert tried > 12


def test_each_member_that_a_problem_carries_is_in_its_schema(client: httpx.Client, document: dict[str, Any]) -> None:
    client.post("/v1/participants", json={"code": "P018"}).raise_for_status()
    old = client.get("/v1/participants/P018").headers["etag"]
    client.put("/v1/participants/P018/profile", json={"current_ma": 8}).raise_for_status()
    stopped = client.get("/v1/rig")
    assert stopped.json()["latch"] == stopped.headers["etag"].strip('"')
    client.post("/v1/stop").raise_for_status()
    answers = [
        client.put("/v1/participants/P018/profile", json={"current_ma": 9}, headers={"If-Match": old}),
        client.post("/v1/rearm", headers={"If-Match": stopped.headers["etag"]}),
        client.post("/v1/tests", json={}),
    ]
    client.post("/v1/rearm").raise_for_status()
    named = document["components"]["schemas"]["Problem"]
    for answer in answers:
        assert answer.is_error and set(answer.json()) <= set(named["properties"]), answer.text
        schema = {**named, "components": document["components"]}
        assert not list(jsonschema_rs.Draft202012Validator(schema).iter_errors(answer.json())), answer.text
    assert "latch" in document["components"]["schemas"]["RigOut"]["properties"]


def test_a_pulse_rate_has_the_range_of_the_rig_where_it_is_played(document: dict[str, Any]) -> None:
    schemas, own = document["components"]["schemas"], HARD_LIMITS["pulse_rate_hz"]
    asked = schemas["TestIn"]["properties"]["pulse_rate_hz"]
    assert (asked["minimum"], asked["maximum"]) == (own.lo, own.hi)
    for name in ("WidthsIn", "ReferenceIn"):
        asked = schemas[name]["properties"]["pulse_rate_hz"]
        assert "default" not in asked or asked["default"] is None
        (number,) = (part for part in asked["anyOf"] if part["type"] == "number")
        assert (number["minimum"], number["maximum"]) == (own.lo, 100.0), "a model of another tool's recording, too"


def test_every_sequence_of_the_rig_says_each_setting_with_its_unit() -> None:
    found = json.loads(plan.library().model_dump_json())
    SequencesOut.model_validate(found)
    assert {"prbs", "ramp", "rest", "widths"} <= {sequence["id"] for sequence in found["sequences"]}
    units = {"_us": "µs", "_s": ", s"}
    for sequence in found["sequences"]:
        jsonschema_rs.meta.validate(sequence["settings"])
        assert sequence["description"].endswith(".")
        for name, setting in sequence["settings"]["properties"].items():
            words = setting["description"]
            assert all(sign in words for suffix, sign in units.items() if name.endswith(suffix)), (name, words)
            bounded = {"minimum", "exclusiveMinimum", "anyOf", "minItems"} & set(setting)
            assert bounded or setting["type"] == "boolean" or name == "max_pulse_width_us", (sequence["id"], name)
    assert [segment["name"] for segment in found["default"]][:2] == ["rest", "prbs"]


def test_the_documents_page_loads_from_this_machine_alone(service: Service) -> None:
    with service.client(None) as http:
        page = http.get("/docs")
        policy = page.headers["content-security-policy"]
        assert "'self'" in policy and "http" not in policy
        loaded = re.findall(r'(?:src|href)="([^"#]+)"', page.text)
        assert any("swagger" in path for path in loaded)
        for path in loaded:
            assert path.startswith("/") and http.get(path).status_code < 400, path

"""The OpenAPI document: what FastAPI finds, and what it cannot see: problems, refused bodies, published schemas."""

from __future__ import annotations

from typing import Any

from stimrig.api import schemas
from stimrig.api.sessions.live import LiveOut
from stimrig.api.web.middleware import REFUSALS
from stimrig.api.web.responses.base import Problem
from stimrig.api.web.responses.models import TrackedOut

PROBLEM_CONTENT = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
EXTENDED = ("Comparison", "Diagnosis", "Improvement", "Inversion")
"""Answers that hold to a published schema, and say more."""
EMBEDDED = ("model", "effects", *map(str.lower, EXTENDED))
DESCRIPTION = """
Programs send `Authorization: Bearer <token>`; browsers have a session's cookie. Each operation names its scope.

Every error is `application/problem+json` (RFC 9457): `title` says what is wrong, `detail` what to do.

A token with `read-model` fetches the approved model: `GET /v1/participants/{code}/model`; with `If-None-Match`, 304
where it is known already. `GET /v1/sequences` says what a test can be made of; its segments go into `POST /v1/preview`,
which plays nothing, and into `POST /v1/tests`.

A decision (approve, set limits, start, re-arm, …) says on what it was made: the `ETag` of the document that its
operation names, as it was last read, in `If-Match`. A controller's key, which reads no participant, names the approved
model's. Without: 428. Changed since: 412, with who changed what from what, and the `ETag` of now. The answer to a
decision carries the new `ETag`.

Live signals come over a WebSocket, `/v1/tests/{id}/live`, with the same token: JSON messages with a `type`, which is
`history` (all curves so far, once), `live` (about 20 a second, see `LiveOut`), `state` (the rig), `link` (is the
rig there), `test` (the test's document), `joint`, `adaptive` or `problem` (docs/api.md says what each holds). It closes
once the test is done.

The same facts as JSON Schemas: `stimrig schema`.
"""


ETAG = {"description": "its version: send it as `If-Match` with what is decided on it", "schema": {"type": "string"}}


def problem(description: str) -> dict[str, Any]:
    """An error's answer."""
    return {"description": description, "content": PROBLEM_CONTENT}


TOO_MANY = problem("too many wrong tries, or too much at once") | {
    "headers": {"Retry-After": {"description": "s to wait", "required": True, "schema": {"type": "integer"}}}
}
"""Response of every operation that checks a token: failed attempts are limited, whatever they were to open."""
CHANGED = problem("changed since: `changes` says who, when, from what to what") | {"headers": {"ETag": ETAG}}
NO_VERSION = problem("`If-Match` is missing, or cannot be read")


def complete(document: dict[str, Any], cookie_name: str) -> None:
    """Add to FastAPI's document what it cannot see."""
    document["components"]["securitySchemes"]["session"]["name"] = cookie_name
    components = document["components"]["schemas"]
    for model in (Problem, LiveOut, TrackedOut):
        schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
        components.update(schema.pop("$defs", {}) | {model.__name__: schema})
    components["JsonValue"] = {"description": "any JSON value: what it holds depends on its key"}
    for name in ("HTTPValidationError", "ValidationError"):  # FastAPI's own words; ours are a Problem
        components.pop(name, None)
    for name in EMBEDDED:
        components.update(schemas.components(name))
    for name in EXTENDED:
        components[f"{name}Out"]["allOf"] = [{"$ref": f"#/components/schemas/{name}Json"}]
    components["ModelJson"]["properties"]["tracking"] = {"$ref": "#/components/schemas/TrackedOut"}
    for methods in document["paths"].values():
        for operation in methods.values():
            ways = operation.get("security", [])
            needed = sorted({scope for way in ways for scopes in way.values() for scope in scopes})
            if ways:
                operation["responses"]["429"] = TOO_MANY
            if needed:
                operation["description"] = f"{operation.get('description', '')}\n\nScope: `{'`, `'.join(needed)}`."
            if "HTTPValidationError" in str(operation["responses"].get("422")):
                del operation["responses"]["422"]
            for header in operation.get("parameters", []):
                if header["name"] == "if-match":
                    header |= {"required": "decided now" not in operation["description"], "schema": {"type": "string"}}
                    operation["responses"] |= {"412": CHANGED, "428": NO_VERSION}
            if "requestBody" in operation:
                for code, words in REFUSALS.items():
                    operation["responses"].setdefault(code, problem(words))

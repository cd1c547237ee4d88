"""Every route x every scope, against a table written apart from the code; and what the head of every answer says."""

from __future__ import annotations

import re
from collections.abc import Iterator
from unittest.mock import Mock

import httpx
import pytest
from fastapi.routing import APIRoute

from stimrig.api.people.auth import Scope
from stimrig.api.web import pages, routes
from stimrig.api.web.app import routers
from tests.api.conftest import TOKEN, Service, run_test, shared_service

SCOPES = ("read-live", "run-test", "rearm", "approve-model", "read-model", "administer")
TABLE = """
GET    /health                                             anybody        200
GET    /metrics                                            anybody        200
GET    /static/page.css                                    anybody        200
GET    /docs                                               anybody        200
GET    /                                                   anybody        200
GET    /rig/now                                            anybody        200
GET    /stopped/x                                          anybody        404
GET    /sign-in                                            anybody        200
POST   /v1/sessions                                        anybody        401
POST   /v1/stop                                            anyone         200
POST   /v1/sessions/confirm                                anyone         422
DELETE /v1/sessions/current                                anyone         404
POST   /v1/sessions/acted                                  anyone         204
GET    /v1/sequences                                       anyone         200
GET    /v1/rig                                             read-live      200
GET    /v1/rig/angle                                       read-live      200
POST   /v1/rig/angle/pose                                  run-test       428
GET    /rig/angle                                          run-test       409
GET    /v1/participants/x/joint                            run-test       404
POST   /v1/participants/x/models                           run-test       422
GET    /participants/x/joint                               run-test       404
GET    /v1/tests                                           read-live      200
GET    /v1/tests/x                                         read-live      404
GET    /tests/x                                            read-live      404
GET    /v1/models/x                                        read-model     404
GET    /v1/models/x/file                                   read-model     404
GET    /v1/models/x/comparison                             read-model     404
GET    /v1/models/x/curves                                 read-model     404
GET    /v1/models/x/diagnosis                              read-model     404
POST   /v1/models/x/prediction                             read-model     422
POST   /v1/models/x/widths                                 read-model     422
GET    /v1/participants/x/model                            read-model     404
GET    /v1/participants/x/models                           read-model     404
GET    /v1/participants/x/tracking                         read-model     404
GET    /v1/participants/x/trend                            read-model     404
GET    /v1/recordings/x                                    read-model     404
GET    /v1/recordings/x/csv                                read-model     404
GET    /v1/effects                                         read-model     200
GET    /v1/jobs/x                                          read-model     404
GET    /models/x                                           read-model     404
GET    /models/x/report                                    read-model     404
GET    /models/x/figures/x                                 read-model     404
GET    /models/x/story.html                                read-model     404
GET    /participants/x/trend                               read-model     404
GET    /jobs/x                                             read-model     404
GET    /v1/participants                                    run-test       200
POST   /v1/participants                                    run-test       422
GET    /v1/participants/x                                  run-test       404
PUT    /v1/participants/x/profile                          run-test       428
POST   /v1/participants/x/recordings                       run-test       428
GET    /v1/participants/x/calibration                      run-test       404
POST   /v1/participants/x/calibration                      run-test       428
POST   /v1/participants/x/calibration/step                 run-test       428
POST   /v1/participants/x/calibration/mark                 run-test       428
POST   /v1/participants/x/calibration/finish               run-test       428
POST   /v1/participants/x/calibration/discard              run-test       428
DELETE /v1/participants/x/keys/x                           run-test       404
POST   /v1/tests                                           run-test       428
POST   /v1/tests/x/enough                                  run-test       404
POST   /v1/preview                                         run-test       422
POST   /v1/models/x/effects                                run-test       422
POST   /v1/models/x/improve                                run-test       404
DELETE /v1/jobs/x                                          run-test       404
GET    /participants/x                                     run-test       404
GET    /participants/x/next                                run-test       404
GET    /participants/x/calibration                         run-test       404
PUT    /v1/participants/x/muscle                           run-test       428
GET    /v1/participants/x/notes                            run-test       404
POST   /v1/participants/x/notes                            run-test       422
POST   /v1/participants/x/notes/x/strike                   run-test       404
POST   /v1/participants/x/keys                             approve-model  428
POST   /v1/rearm                                           rearm          428
POST   /v1/models/x/approve                                approve-model  428
POST   /v1/models/x/reject                                 approve-model  404
POST   /v1/tokens                                          administer     422
GET    /v1/tokens                                          administer     200
DELETE /v1/tokens/x                                        administer     404
GET    /v1/audit                                           administer     200
POST   /v1/users                                           administer     422
GET    /v1/users                                           administer     200
PUT    /v1/users/x/password                                administer     428
DELETE /v1/users/x                                         administer     404
GET    /administration                                     administer     200
GET    /administration/audit.jsonl                         administer     200
GET    /participants/x/start                               run-test       404
"""
"""Method, path, who may, and what they are answered, where nothing of the name x is there and no body is sent.

4xx: whatever the form says is missing."""
ROWS = [tuple(line.split()) for line in TABLE.strip().splitlines()]
IN_PATHS = {"{direction}": "up", "{threshold}": "motor"}
shared = shared_service()


def filled(path: str) -> str:
    return re.sub(r"\{\w+\}", lambda found: IN_PATHS.get(found[0], "x"), path)


def test_the_table_names_every_route() -> None:
    """A new route goes into the table, with who may use it: that is decided there first, then in the code."""
    there = {
        (method, filled(route.path).replace("/static/x", "/static/page.css"))
        for router in routers(routes, pages)
        for route in router.routes
        if isinstance(route, APIRoute)  # the live channel has a test of its own
        for method in route.methods
    }
    assert there == {(method, path) for method, path, _, _ in ROWS}
    assert set(SCOPES) == {scope.value for scope in Scope}


@pytest.fixture(scope="module")
def holders(shared: Service) -> dict[str, str]:
    return {scope: f"Bearer {shared.token(scope, scope)}" for scope in SCOPES}


@pytest.fixture(scope="module")
def http(shared: Service) -> Iterator[httpx.Client]:
    with shared.client(token=None, auth=None) as client:  # it does not look first: what decides is told so
        yield client


def test_each_scope_gets_what_the_table_says(http: httpx.Client, holders: dict[str, str]) -> None:
    for method, path, who, status in ROWS:
        expected = dict.fromkeys(SCOPES, "403") | {"nobody": status if who == "anybody" else "401"}
        expected |= {scope: status for scope in SCOPES if who in (scope, "anybody", "anyone") or scope == "administer"}
        found = {}
        for number, holder in enumerate(expected):
            head = {"Authorization": holders[holder]} if holder in holders else {}
            head["X-Forwarded-For"] = f"10.0.0.{number}"  # nobody is held back for another's tries
            form = {"data": {"name": holder}} if path == "/v1/sessions" else {}
            code = http.request(method, path, headers=head, **form).status_code
            known = expected[holder] == "4xx" and code in {*range(400, 500)} - {401, 403}
            found[holder] = "4xx" if known else str(code)
        assert found == expected, (method, path)


def test_forms_of_another_page_change_nothing(shared: Service) -> None:
    """A session without its CSRF token may look and may stop: every route that writes is tried."""
    with shared.client(token=None) as page:
        assert page.post("/v1/sessions", data={"token": TOKEN}).status_code == 303
        tried = 0
        for method, path, who, _ in ROWS:
            if method == "GET" or who == "anybody" or path == "/v1/stop":
                continue
            answer = page.request(method, path, auth=None)
            assert (answer.status_code, answer.json()["type"]) == (403, "/problems/csrf"), (method, path)
            tried += 1
        assert tried > 30 and page.post("/v1/stop").status_code == 200


# ---- heads --------------------------------------------------------------------------------------------------


def policy(answer: httpx.Response) -> dict[str, list[str]]:
    parts = [part.split() for part in answer.headers["content-security-policy"].split(";")]
    return {part[0]: part[1:] for part in parts if part}


@pytest.mark.parametrize(("method", "path"), [row[:2] for row in ROWS[::8]])
def test_every_answer_says_load_from_here_alone_and_keep_nothing(http: httpx.Client, method: str, path: str) -> None:
    token = {"Authorization": f"Bearer {TOKEN}"}
    for asks in ({}, token, {"Accept": "text/html"}, token | {"Accept": "text/html"}):
        answer = http.request(method, path, headers=asks)
        head, said = answer.headers, policy(answer)
        assert head["x-content-type-options"] == "nosniff"
        assert head["cross-origin-resource-policy"] == head["cross-origin-opener-policy"] == "same-origin"
        assert said["default-src"] == said["base-uri"] == said["frame-ancestors"] == ["'none'"]
        assert "script-src" not in said or said["script-src"] == ["'self'"]
        if head.get("content-type", "").startswith("text/html"):
            assert said["connect-src"] == said["form-action"] == ["'self'"]
            assert head["referrer-policy"] == "same-origin", "its own address goes to this service alone"
        else:
            assert said["form-action"] == ["'none'"] and head["referrer-policy"] == "no-referrer"
        assert head["cache-control"] == ("public, max-age=31536000, immutable" if "/static/" in path else "no-store")
        assert "*" not in head["content-security-policy"] and "http" not in head["content-security-policy"]


def test_what_goes_wrong_has_the_same_head(
    service: Service, client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.context.people, "documents", Mock(side_effect=RuntimeError("unexpected words")))
    model = run_test(client, participant)
    client.post(f"{model['model_url']}/approve")
    for answer, status in (
        (client.get("/v1/users", headers={"Connection": "close"}), 500),
        (client.get("/nowhere"), 404),
        (client.put("/v1/tests"), 405),
        (client.get("/openapi.json"), 200),
        (client.get(model["recording_url"]), 200),
        (client.get(f"{model['recording_url']}/csv"), 200),
        (client.get(f"{model['model_url']}/file"), 200),
    ):
        assert answer.status_code == status and "unexpected words" not in answer.text
        assert answer.headers["x-content-type-options"] == "nosniff" and answer.headers["cache-control"] == "no-store"
        assert policy(answer)["default-src"] == ["'none'"]
    fetched = client.get(f"/v1/participants/{participant}/model")
    assert fetched.headers["cache-control"] == "private, no-cache", "a controller asks with its ETag"

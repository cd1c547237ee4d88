"""A stored version never changes, by no route and by no second storing."""

from __future__ import annotations

import json

import httpx
import pytest

from api.errors import ApiError
from tests.api.conftest import Service, run_test


def test_version_with_other_contents_is_refused_and_the_old_one_stays(
    service: Service, client: httpx.Client, participant: str
) -> None:
    document = run_test(client, participant)
    path = f"/v1/models/{document['model_id']}/file"
    before = client.get(path)
    model = json.loads(before.content)
    model["recruitment"]["torque_nm"][-1] += 1.0
    versions = service.app.state.context.versions
    with pytest.raises(ApiError, match="cannot be changed"):
        versions.add(json.dumps(model), participant, document["recording_id"], "somebody")
    same = versions.add(before.content.decode(), participant, document["recording_id"], "somebody")
    assert same.created_by != "somebody"
    after = client.get(path)
    assert after.content == before.content and after.headers["etag"] == before.headers["etag"]


def test_no_route_changes_or_deletes_a_model(client: httpx.Client, participant: str) -> None:
    document = run_test(client, participant)
    for address in (document["model_url"], f"{document['model_url']}/file", document["recording_url"]):
        for method in ("PUT", "PATCH", "DELETE"):
            assert client.request(method, address).status_code == 405
    described = client.get("/openapi.json").json()["paths"]
    changing = {
        (method, path)
        for path, methods in described.items()
        for method in methods
        if method in ("put", "patch", "delete") and ("/models" in path or "/recordings" in path)
    }
    assert changing == set()

"""Damaged bytes of a stored model keep nobody from a test, and cost what is read off that model only."""

from __future__ import annotations

from typing import Any

import httpx

from stimrig.api.store.tables import Model
from tests.api.conftest import Service, run_test
from tests.api.test_problems import problem

ASKED = {"participant": "P017"}


def damage(service: Service, model_id: str) -> None:
    """A bit that has turned on the disk."""
    body = service.context.versions.get(model_id).document
    service.change(Model, model_id, document=body.replace(b"1", b"2", 1))


def test_everything_that_is_not_read_off_it_is_there(
    client: httpx.Client, service: Service, pages: httpx.Client, approved: str
) -> None:
    test_id = client.get("/v1/tests").json()[0]["id"]
    damage(service, approved)
    assert client.post("/v1/preview", json=ASKED).json()["torque_time_nms"] is None, "the estimate alone is missing"
    for path in ("tests", "participants/P017", "participants/P017/models", "participants/P017/trend"):
        assert client.get(f"/v1/{path}").status_code == 200, path
    assert client.get(f"/v1/tests/{test_id}").json()["fit"]["verdict"] == "usable", "kept beside it"
    for path in ("/", "/participants/P017", "/participants/P017/next", "/participants/P017/trend",
                 f"/tests/{test_id}"):  # fmt: skip
        assert pages.get(path).status_code == 200, path
    for path in (f"/models/{approved}", f"/models/{approved}/report"):
        page = pages.get(path, headers={"Connection": "close"})
        assert page.status_code == 500 and "The stored model is damaged" in page.text and approved in page.text
    for path in ("", "/comparison", "/diagnosis"):
        told: Any = problem(client.get(f"/v1/models/{approved}{path}"), 500)
        assert told["type"] == "/problems/model-damaged" and "from a backup" in told["detail"]
    assert run_test(client, "P017")["state"] == "completed", "the next test has a model of its own"


def test_a_damaged_model_reaches_no_controller_and_is_not_approved(
    client: httpx.Client, service: Service, approved: str
) -> None:
    seen = {"If-Match": client.get(f"/v1/models/{approved}").headers["etag"]}
    damage(service, approved)
    for answer in (
        client.get("/v1/participants/P017/model"),
        client.get(f"/v1/models/{approved}/file"),
        client.post(f"/v1/models/{approved}/approve", json={"reason": "again"}, headers=seen),
    ):
        assert problem(answer, 500)["type"] == "/problems/model-damaged"
    assert client.get("/metrics").status_code == 200
    assert client.post(f"/v1/models/{approved}/reject", json={"reason": "damaged"}, headers=seen).status_code == 200
    assert problem(client.get("/v1/participants/P017/model"), 404)["type"] == "/problems/no-approved-model"

"""Everything that goes wrong comes as RFC 9457 problem+json that names the place and the fix."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import pytest

import stimrig
from stimrig.api import errors
from stimrig.api.sessions import runner
from stimrig.api.store.tables import Model
from stimrig.rig.messages import Problem as RigProblem
from tests.api.conftest import Service, let_go, run_test, soon, wait_done

GOOD_HEADER = "time_s,pulse_width_us,torque_nm,segment\n"


def problem(answer: httpx.Response, status: int) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body = answer.json()
    assert body["status"] == status and body["title"] and body["type"].startswith("/problems/")
    assert "Traceback" not in answer.text
    return body


@pytest.mark.parametrize(("body", "field"), [
    ({"code": "Anna Schmidt"}, "code"), ({"code": "x" * 33}, "code"), ({"code": ""}, "code"), ({}, "code"),
    ({"code": "P1\n"}, "code"), ({"code": "P1", "name": "Anna"}, "name"),
    ({"code": "P1", "profile": {"current_ma": -1}}, "profile.current_ma"),
    ({"code": "P1", "profile": {"max_pulse_width_us": "wide"}}, "profile.max_pulse_width_us"),
])  # fmt: skip
def test_participant_that_does_not_hold(shared_client: httpx.Client, body: dict[str, Any], field: str) -> None:
    found = problem(shared_client.post("/v1/participants", json=body), 422)
    assert field in [error["field"] for error in found["errors"]]
    assert shared_client.get("/v1/participants").json() == []


@pytest.mark.parametrize(("method", "path", "status"), [
    ("GET", "/nowhere", 404), ("DELETE", "/v1/participants", 405), ("GET", "/v1/tests/T1", 404),
    ("GET", "/static/../app.py", 404), ("GET", "/static/app.py", 404),
])  # fmt: skip
def test_what_is_not_there(shared_client: httpx.Client, method: str, path: str, status: int) -> None:
    problem(shared_client.request(method, path), status)


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "fix"),
    [
        ("POST", "/v1/participants", {"code": "P017"}, 409, "Take another"),
        ("POST", "/v1/tests", {"participant": "P404"}, 404, "POST /v1/participants"),
        ("GET", "/v1/participants/P017/model", None, 404, "approve"),
        ("POST", "/v1/tokens", {"name": "x", "scopes": ["everything"]}, 422, "read-model"),
        ("POST", "/v1/tests", "{", 422, "The body is no JSON from character 1 on."),
    ],
)
def test_a_refusal_names_its_fix(
    client: httpx.Client, participant: str, method: str, path: str, body: Any, status: int, fix: str
) -> None:
    sent: dict[str, Any] = {"content": body} if isinstance(body, str) else {"json": body}
    head = {"If-Match": '"1"', "content-type": "application/json"}
    assert fix in problem(client.request(method, path, headers=head, **sent), status)["detail"] and participant


def test_rig_that_is_gone_and_comes_back(client: httpx.Client, service: Service, participant: str) -> None:
    service.rig_thread.__exit__()
    soon(lambda: not client.get("/v1/rig").json()["connected"])
    found = problem(client.post("/v1/tests", json={"participant": participant}), 503)
    assert found["title"] == "The rig cannot be reached"
    health = client.get("/health").json()
    assert health["status"] == "degraded" and health["rig"]["state"] == "disconnected"
    service.rig_thread.__enter__()
    service.rig.speed = 30.0
    soon(lambda: client.get("/health").json()["status"] == "ok", 60)
    assert run_test(client, participant)["state"] == "completed"


def test_a_rest_that_is_needed_has_a_code_of_its_own() -> None:
    told = errors.from_rig(RigProblem(code="rest-needed", title="The muscle has to rest first", detail="wait 0.3 s"))
    assert (told.status, told.body()["type"]) == (422, "/problems/rig-rest-needed")


def test_rig_that_dies_in_a_test_ends_the_test(client: httpx.Client, service: Service, participant: str) -> None:
    service.rig.speed = 0.5
    test_id = client.post("/v1/tests", json={"participant": participant}).json()["id"]
    soon(lambda: service.rig.state == "running")
    service.rig_thread.__exit__()
    soon(lambda: not client.get("/v1/rig").json()["connected"])
    service.rig_thread.__enter__()
    document = wait_done(client, test_id)
    assert document["state"] == "fault" and "rig's process ended" in document["reason"]
    assert let_go(client)


def test_rig_that_does_not_answer_a_start_is_stopped(
    client: httpx.Client, service: Service, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may have heard the command: nothing plays on that nobody follows."""
    monkeypatch.setattr(runner, "ANSWER_S", 0.5)
    service.rig.ignores_starts = True
    answer = problem(client.post("/v1/tests", json={"participant": participant}), 503)
    assert answer["type"] == "/problems/rig-unreachable"
    assert (service.rig.state, service.rig.reason) == ("latched", "stopped by service")
    assert client.get("/v1/rig").json()["holder"] is None
    assert client.get("/v1/tests").json()[0]["state"] == "refused"


def test_upload_of_a_table_whose_columns_are_named(client: httpx.Client, service: Service, participant: str) -> None:
    """Kept as a table of ours, with the SHA-256 of what was sent; what was assumed is told, and stays told."""
    rows = "".join(f"{k * 25};{100 * (k // 20 % 2)};{k % 7},5\n" for k in range(400))
    sent = ("t;Breite;M\n" + rows).encode()
    columns = ["time_s=t:ms", "pulse_width_us=Breite:µs", "torque_nm=M:Ncm"]
    answer = client.post(f"/v1/participants/{participant}/recordings", content=sent, params={"map": columns})
    assert answer.status_code == 201, answer.text
    told = answer.json()["warnings"]
    assert told[0] == "semicolons between cells, decimal commas"
    assert "found from the pulse widths" in told[1] and len(told) == 2
    kept = client.get(answer.headers["location"]).text
    header, *cells = kept.splitlines()
    assert header.startswith("time_s,pulse_width_us,torque_nm,segment,") and len(cells) == 400
    assert [float(cell) for cell in cells[2].split(",")[:3]] == pytest.approx([0.05, 0.0, 0.025])
    assert hashlib.sha256(sent).hexdigest() in kept
    assert [path.suffix for path in (service.data / "recordings").rglob("upload-*")] == [".csv"]


@pytest.mark.parametrize("columns", [[], ["torque_nm=torque_nm:Nm"]])
def test_upload_of_a_parquet_file(client: httpx.Client, participant: str, columns: list[str], tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="pip install pyarrow")
    (tmp_path / "sent.csv").write_text(
        GOOD_HEADER + "".join(f"{k / 40},{100 * (k // 20 % 2)},{k % 7},prbs\n" for k in range(400))
    )
    sent = stimrig.save(stimrig.read(tmp_path / "sent.csv"), tmp_path / "sent.parquet").read_bytes()
    where = f"/v1/participants/{participant}/recordings"
    answer = client.post(where, content=sent, params={"map": columns})
    assert answer.status_code == 201, answer.text
    kept = client.get(answer.headers["location"])
    kind = "text/csv" if columns else "application/vnd.apache.parquet"
    assert kept.headers["content-type"].startswith(kind) and (kept.content == sent) == (not columns)


def test_upload_too_large_or_empty(client: httpx.Client, service: Service, participant: str) -> None:
    service.context.settings.max_upload_mb = 0.001
    problem(client.post(f"/v1/participants/{participant}/recordings", content=b"x" * 2000), 413)
    problem(client.post(f"/v1/participants/{participant}/recordings", content=b""), 422)
    assert list((service.data / "recordings").rglob("upload-*")) == []


def test_unforeseen_error_is_a_problem_too(client: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(service.context.versions, "get", Mock(side_effect=RuntimeError("secret detail")))
    assert "secret detail" not in str(problem(client.get("/v1/models/M1"), 500))


# ---- Damaged bytes of a stored model keep nobody from a test, and cost what is read off that model only.


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

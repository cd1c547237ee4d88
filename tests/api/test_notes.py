"""Notes: on a session, on a test, at a time in it; struck and never deleted; and what may not stand in one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.api.conftest import Service, run_test, shared_service, soon, wait_done

service = shared_service()


@pytest.fixture(scope="module")
def made(service: Service) -> Iterator[tuple[httpx.Client, dict[str, Any]]]:
    with service.client() as http:
        http.post("/v1/participants", json={"code": "N1"})
        yield http, run_test(http, "N1")


def test_a_note_is_kept_struck_and_never_deleted(made: tuple[httpx.Client, dict[str, Any]]) -> None:
    http, _test = made
    http.post("/v1/participants", json={"code": "N2"})
    written = http.post("/v1/participants/N2/notes", json={"kind": "posture", "text": "  sat up straight "})
    assert written.status_code == 201 and written.json()["text"] == "sat up straight"
    note = written.json()
    for _ in range(2):
        struck = http.post(f"/v1/participants/N2/notes/{note['id']}/strike")
        assert struck.status_code == 200 and struck.json()["struck_by"] == "administrator"
    (kept,) = http.get("/v1/participants/N2/notes").json()
    assert kept == {**note, "struck_by": "administrator", "struck_utc": struck.json()["struck_utc"]}
    trail = [entry for entry in http.get("/v1/audit").json()["entries"] if entry["subject"] == "N2"]
    assert [entry["action"] for entry in trail] == ["create participant", "note", "strike note"]


def test_a_time_lies_in_the_test_of_this_participant(made: tuple[httpx.Client, dict[str, Any]]) -> None:
    http, test = made
    last_s = test["summary"]["duration_s"]

    def note(code: str = "N1", **fields: Any) -> httpx.Response:
        return http.post(f"/v1/participants/{code}/notes", json={"kind": "spasm", "test_id": test["id"], **fields})

    assert note(at_s=last_s / 2).json()["at_s"] == last_s / 2
    assert note().json()["at_s"] is None
    assert note(at_s=last_s + 1).status_code == 422
    assert note(at_s=-1).status_code == 422
    assert note(now=True).status_code == 409, "it is over"
    assert note(at_s=1, now=True).status_code == 422
    http.post("/v1/participants", json={"code": "N3"})
    assert note("N3").status_code == 404
    assert note("nobody").status_code == 404
    assert http.post("/v1/participants/N1/notes", json={"kind": "spasm", "at_s": 1}).status_code == 422


def test_now_is_where_the_running_test_stands(service: Service) -> None:
    service.rig.speed = 2.0
    with service.client() as http:
        http.post("/v1/participants", json={"code": "N4"})
        test = http.post("/v1/tests", json={"participant": "N4"}).json()
        elapsed_s = soon(lambda: http.get(f"/v1/tests/{test['id']}").json()["elapsed_s"])
        body = {"kind": "spasm", "test_id": test["id"], "now": True}
        note = http.post("/v1/participants/N4/notes", json=body).json()
        service.rig.speed = 60.0
        after = wait_done(http, test["id"])
        assert elapsed_s - 0.01 <= note["at_s"] <= after["summary"]["duration_s"]


@pytest.mark.parametrize(
    "fields",
    [
        {"kind": "other"},
        {"kind": "other", "text": " "},
        {"kind": "nonsense"},
        {"kind": "spasm", "text": "x" * 501},
        {"kind": "spasm", "text": "x" * 100_000},
        {"kind": "spasm", "text": "two\nlines"},
        {"kind": "spasm", "text": "a\u202eb"},
        {"kind": "spasm", "text": "a\u200bb"},
        {"kind": "spasm", "text": "a\x00b"},
        {"kind": "spasm", "text": 3},
        {"kind": "spasm", "more": 1},
    ],
    ids=lambda fields: repr(fields)[:40],
)
def test_what_is_no_note_is_refused(made: tuple[httpx.Client, dict[str, Any]], fields: dict[str, Any]) -> None:
    http, _test = made
    before = len(http.get("/v1/participants/N1/notes").json())
    answer = http.post("/v1/participants/N1/notes", json=fields)
    assert answer.status_code == 422 and len(answer.text) < 2000, answer.text[:500]
    assert len(http.get("/v1/participants/N1/notes").json()) == before


def test_letters_are_composed(made: tuple[httpx.Client, dict[str, Any]]) -> None:
    http, _test = made
    answer = http.post("/v1/participants/N1/notes", json={"kind": "other", "text": "Mu\u0308de <b>"})
    assert answer.json()["text"] == "Müde <b>"

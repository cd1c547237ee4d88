"""The list of participants, side and muscle, and who ran a test."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from sqlalchemy import event

from stimrig.api.store.tables import Participant
from tests.api.conftest import Service, run_test, shared_service, soon, wait_done

service = shared_service()


@pytest.fixture
def http(service: Service) -> Iterator[httpx.Client]:
    with service.client() as client:
        yield client


def make(http: httpx.Client, code: str, **more: Any) -> None:
    assert http.post("/v1/participants", json={"code": code, **more}).status_code == 201


def test_the_site_stays_while_a_test_of_the_participant_plays(service: Service, http: httpx.Client) -> None:
    make(http, "A1", side="left")
    service.rig.speed = 2.0
    test = http.post("/v1/tests", json={"participant": "A1"}).json()
    refused = http.put("/v1/participants/A1/muscle", json={"side": "right"})
    assert refused.status_code == 409 and refused.json()["type"] == "/problems/participant-busy", "in a test"
    service.rig.speed = 60.0
    assert wait_done(http, test["id"])["side"] == "left"


def test_the_list_is_searched_and_most_recent_first(http: httpx.Client) -> None:
    for code in ("S_1", "S_2", "Sx2"):
        make(http, code)
    run_test(http, "S_1")
    assert [row["code"] for row in http.get("/v1/participants", params={"q": "s_"}).json()] == ["S_1", "S_2"]
    assert http.get("/v1/participants", params={"q": "%"}).json() == []
    assert http.get("/v1/participants", params={"q": "x" * 81}).status_code == 422


def test_a_test_keeps_the_side_it_was_begun_with_and_says_who_ran_it(http: httpx.Client) -> None:
    make(http, "M1", side="left", muscle="biceps brachii")
    test = http.post("/v1/tests", json={"participant": "M1", "ran_by": "Jörg  Müller"}).json()
    wait_done(http, test["id"])
    assert http.put("/v1/participants/M1/muscle", json={"side": "right", "muscle": "biceps brachii"}).status_code == 200
    kept = http.get(f"/v1/tests/{test['id']}").json()
    assert (kept["side"], kept["muscle"]) == ("left", "biceps brachii")
    assert (kept["requested_by"], kept["ran_by"]) == ("administrator", "Jörg Müller")
    again = run_test(http, "M1")
    assert (again["side"], again["ran_by"]) == ("right", "administrator")


@pytest.mark.parametrize("body", [{"side": "both"}, {"muscle": ""}, {"muscle": "x" * 61}, {"muscle": "a\nb"}])
def test_what_is_no_side_or_muscle_is_refused(http: httpx.Client, body: dict[str, Any]) -> None:
    http.post("/v1/participants", json={"code": "M1"})  # another test may have made it
    assert http.put("/v1/participants/M1/muscle", json=body).status_code == 422
    assert http.post("/v1/participants", json={"code": "M9", **body}).status_code == 422


def test_thresholds_of_one_arm_do_not_hold_for_the_other(service: Service, http: httpx.Client) -> None:
    make(http, "M2")
    http.put("/v1/participants/M2/muscle", json={"side": "left"})
    found = {"motor_pulse_width_us": 80.0, "set_at_utc": "2026-03-01T10:00:00.000Z"}
    service.change(Participant, "M2", profile=lambda old: old | found)
    refused = http.put("/v1/participants/M2/muscle", json={"side": "right"})
    assert refused.status_code == 409 and "left" in refused.json()["detail"]
    assert http.get("/v1/participants/M2").json()["side"] == "left"
    token = {"confirm": refused.json()["confirm"]["token"]}
    done = http.put("/v1/participants/M2/muscle", params=token, json={"side": "right"}).json()
    assert done["side"] == "right" and done["profile"]["motor_pulse_width_us"] is None


def test_the_first_page_asks_as_much_of_the_database_for_many_as_for_few(service: Service, http: httpx.Client) -> None:
    store = service.context.store
    asked: list[str] = []
    event.listen(store.engine, "before_cursor_execute", lambda *given: asked.append(given[2]))

    def once(path: str, html: bool) -> int:
        asked.clear()
        answer = http.get(path, headers={"Accept": "text/html"} if html else {})
        assert answer.status_code == 200
        return len(asked)

    def count(path: str, html: bool = False) -> int:
        """The fewest of some tries: what the service does by itself asks the database meanwhile, too."""
        return min(once(path, html) for _ in range(5))

    few = count("/v1/participants"), count("/?all=1", html=True)
    now = service.context.clock.utc()
    with store.write() as session:
        for number in range(500):
            session.add(
                Participant(code=f"Z{number:03d}", profile={"current_ma": 20.0}, created_utc=now, created_by="t")
            )
    assert (count("/v1/participants"), count("/?all=1", html=True)) == few
    assert len(http.get("/v1/participants", params={"q": "Z"}).json()) == 500


# ---- Notes: on a session, on a test, at a time in it; struck and never deleted; and what may not stand in one


@pytest.fixture(scope="module")
def made(service: Service) -> Iterator[tuple[httpx.Client, dict[str, Any]]]:
    with service.client() as http:
        http.post("/v1/participants", json={"code": "N1"})
        yield http, run_test(http, "N1")


def test_a_note_is_kept_struck_and_never_deleted(made: tuple[httpx.Client, dict[str, Any]]) -> None:
    http, _test = made
    http.post("/v1/participants", json={"code": "N2"})
    written = http.post("/v1/participants/N2/notes", json={"kind": "posture", "text": "  Mu\u0308de <b> "})
    assert written.status_code == 201 and written.json()["text"] == "Müde <b>"
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


def test_now_is_where_the_running_test_stands(service: Service, client: httpx.Client) -> None:
    service.rig.speed = 2.0
    client.post("/v1/participants", json={"code": "N4"})
    test = client.post("/v1/tests", json={"participant": "N4"}).json()
    elapsed_s = soon(lambda: client.get(f"/v1/tests/{test['id']}").json()["elapsed_s"])
    body = {"kind": "spasm", "test_id": test["id"], "now": True}
    note = client.post("/v1/participants/N4/notes", json=body).json()
    service.rig.speed = 60.0
    after = wait_done(client, test["id"])
    assert elapsed_s - 0.01 <= note["at_s"] <= after["summary"]["duration_s"]


@pytest.mark.parametrize("fields", [
    {"text": "electrode 2 moved"}, {"kind": "other"}, {"kind": "other", "text": " "}, {"kind": "nonsense"},
    {"kind": "spasm", "text": "x" * 100_000}, {"kind": "spasm", "text": "two\nlines"},
    {"kind": "spasm", "text": "a\u202eb"}, {"kind": "spasm", "text": "a\u200bb"}, {"kind": "spasm", "text": "a\x00b"},
    {"kind": "spasm", "text": 3}, {"kind": "spasm", "more": 1},
], ids=lambda fields: repr(fields)[:40])  # fmt: skip
def test_what_is_no_note_is_refused(made: tuple[httpx.Client, dict[str, Any]], fields: dict[str, Any]) -> None:
    http, _test = made
    before = len(http.get("/v1/participants/N1/notes").json())
    answer = http.post("/v1/participants/N1/notes", json=fields)
    assert answer.status_code == 422 and len(answer.text) < 2000, answer.text[:500]
    assert len(http.get("/v1/participants/N1/notes").json()) == before

"""The list of participants, the archive, side and muscle, and who ran a test."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from sqlalchemy import event

from stimrig.api.store.tables import Participant
from tests.api.conftest import Service, run_test, shared_service, wait_done
from tests.api.test_access import csrf, signed_in

service = shared_service()


@pytest.fixture
def http(service: Service) -> Iterator[httpx.Client]:
    with service.client() as client:
        yield client


def make(http: httpx.Client, code: str, **more: Any) -> None:
    assert http.post("/v1/participants", json={"code": code, **more}).status_code == 201


def test_an_archived_participant_is_left_alone_until_it_is_taken_out(http: httpx.Client) -> None:
    make(http, "A1")
    assert http.post("/v1/participants/A1/archive").json()["archived_utc"]
    for path, body in (("/v1/tests", {"participant": "A1"}), ("/v1/participants/A1/calibration", {})):
        refused = http.post(path, json=body)
        assert refused.status_code == 409 and refused.json()["type"] == "/problems/archived", refused.text
        assert "unarchive" in refused.json()["detail"]
    assert "A1" not in [row["code"] for row in http.get("/v1/participants", params={"archived": False}).json()]
    assert [row["code"] for row in http.get("/v1/participants", params={"archived": True}).json()] == ["A1"]
    assert http.post("/v1/participants/A1/unarchive").json()["archived_utc"] is None
    assert run_test(http, "A1")["state"] == "completed"
    trail = [entry["action"] for entry in http.get("/v1/audit").json()["entries"] if entry["subject"] == "A1"]
    assert trail == ["create participant", "archive", "unarchive"]
    seen = {"If-Match": http.get("/v1/participants/A1").headers["etag"]}
    refused = http.post("/v1/participants/nobody/archive", headers=seen)
    assert refused.status_code == 409 and "no version of /v1/participants/nobody" in refused.json()["detail"]


def test_nobody_is_archived_in_the_middle_of_a_test(service: Service, http: httpx.Client) -> None:
    make(http, "A2", side="left")
    service.rig.speed = 2.0
    test = http.post("/v1/tests", json={"participant": "A2"}).json()
    for refused in (
        http.post("/v1/participants/A2/archive"),
        http.put("/v1/participants/A2/muscle", json={"side": "right"}),
    ):
        assert refused.status_code == 409 and refused.json()["type"] == "/problems/participant-busy"
    service.rig.speed = 60.0
    assert wait_done(http, test["id"])["side"] == "left"
    assert http.post("/v1/participants/A2/archive").status_code == 200


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
    assert http.put("/v1/participants/M1/muscle", json=body).status_code == 422
    assert http.post("/v1/participants", json={"code": "M9", **body}).status_code == 422


def test_thresholds_of_one_arm_do_not_hold_for_the_other(service: Service, http: httpx.Client) -> None:
    make(http, "M2")
    http.put("/v1/participants/M2/muscle", json={"side": "left"})
    store = service.app.state.context.store
    with store.write() as session:
        row = session.get(Participant, "M2")
        row.profile = {**row.profile, "motor_pulse_width_us": 80.0, "set_at_utc": "2026-03-01T10:00:00.000Z"}
    refused = http.put("/v1/participants/M2/muscle", json={"side": "right"})
    assert refused.status_code == 409 and "left" in refused.json()["detail"]
    assert http.get("/v1/participants/M2").json()["side"] == "left"
    done = http.put("/v1/participants/M2/muscle?void_calibration=true", json={"side": "right"}).json()
    assert done["side"] == "right" and done["profile"]["motor_pulse_width_us"] is None


def test_the_first_page_asks_as_much_of_the_database_for_many_as_for_few(service: Service, http: httpx.Client) -> None:
    store = service.app.state.context.store
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
    now = service.app.state.context.clock.utc()
    with store.write() as session:
        for number in range(500):
            session.add(
                Participant(code=f"Z{number:03d}", profile={"current_ma": 20.0}, created_utc=now, created_by="t")
            )
    assert (count("/v1/participants"), count("/?all=1", html=True)) == few
    assert len(http.get("/v1/participants", params={"q": "Z"}).json()) == 500


def test_the_page_of_an_archived_participant_offers_the_way_out_and_no_test(
    service: Service, http: httpx.Client
) -> None:
    make(http, "A3")
    http.post("/v1/participants/A3/archive")
    with signed_in(service) as browser:
        page = browser.get("/participants/A3").text
        assert 'data-next="archived"' in page and "In the archive since" in page
        assert "Start the pre-session test" not in page and "A3/calibration" not in page
        assert page.count('action="/participants/A3/unarchive"') == 2, "in the line that says what is next, and below"
        out = browser.post("/participants/A3/unarchive", data={"csrf": csrf(browser)})
        assert out.status_code == 303
        assert "Start the pre-session test" in browser.get("/participants/A3").text


def test_side_and_muscle_are_asked_for_on_the_page(service: Service, http: httpx.Client) -> None:
    with signed_in(service) as browser:
        assert '<option value="right"' in browser.get("/").text and 'name="muscle"' in browser.get("/").text
        form = {"csrf": csrf(browser), "code": "A4", "side": "right", "muscle": "triceps brachii"}
        assert browser.post("/participants", data=form).headers["location"] == "/participants/A4"
    made = http.get("/v1/participants/A4").json()
    assert (made["side"], made["muscle"]) == ("right", "triceps brachii")

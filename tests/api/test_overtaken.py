"""What is asked for and then overtaken, by a stop, by other limits, by time, is not played once the way is free."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from unittest.mock import Mock

import httpx
import pytest
from sqlalchemy.exc import OperationalError

from stimrig.api.services import calibrations
from stimrig.api.sessions import runner
from tests.api.conftest import Service, run_test
from tests.api.test_profiles import mark_all


class Held:
    """Holds a call back until it is let go; `reached` says that it has come."""

    def __init__(self) -> None:
        self.reached, self.free = threading.Event(), threading.Event()

    def wait(self) -> None:
        self.reached.set()
        assert self.free.wait(20)


def stopped_and_re_armed(client: httpx.Client) -> None:
    assert client.post("/v1/stop", json={"reason": "now"}).status_code == 200
    assert client.post("/v1/rearm").status_code == 200


def lowered(client: httpx.Client) -> None:
    assert client.put("/v1/participants/P017/profile", json={"current_ma": 5}).status_code == 200


@pytest.mark.parametrize(
    ("meanwhile", "within_s", "status", "words"),
    [
        (stopped_and_re_armed, 10.0, 409, "cancelled by a stop"),
        (lowered, 10.0, 412, "changed since"),
        (lambda _client: None, 0.0, 503, "took too long"),
    ],
)
def test_a_start_that_is_overtaken_is_not_played(
    client: httpx.Client, service: Service, participant: str, monkeypatch: pytest.MonkeyPatch,
    meanwhile: Callable[[httpx.Client], None], within_s: float, status: int, words: str,
) -> None:  # fmt: skip
    """It waits in the service, after all that was read for it and before its command to the rig."""
    target, held = service.context.runner, Held()
    write = target._write_intent
    monkeypatch.setattr(target, "_write_intent", lambda *given: (write(*given), held.wait()))
    monkeypatch.setattr(runner, "START_S", within_s)
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(client.post, "/v1/tests", json={"participant": participant})
        assert held.reached.wait(20)
        meanwhile(client)
        held.free.set()
        answer = asked.result()
    assert answer.status_code == status and words in answer.json()["title"]
    assert service.rig.starts == 0
    monkeypatch.undo()
    assert client.post("/v1/tests", json={"participant": participant}).status_code == 202


# ---- between the command and the first pulse ---------------------------------------------------------------------


PLAN = {"name": "ilc", "current_ma": 15, "max_pulse_width_us": 200, "max_duration_s": 60, "trials": 3}
TRIAL = {"kind": "sequence", "segments": [
    {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": [0, 100, 150] * 20}}]}  # fmt: skip


def key_of(
    service: Service, client: httpx.Client, participant: str, maker: httpx.Client | None = None
) -> tuple[str, httpx.Client]:
    """A controller's key of the participant: its public id, and a client with it."""
    made = (maker or client).post(f"/v1/participants/{participant}/keys", json=PLAN)
    assert made.status_code == 201, made.text
    return made.json()["id"], service.client(made.json()["key"])


CHANGES: dict[str, Callable[[httpx.Client, str, str, str], httpx.Response]] = {
    "key revoked": lambda http, code, key, _model: http.delete(f"/v1/participants/{code}/keys/{key}"),
    "model rejected": lambda http, _code, _key, model: http.post(
        f"/v1/models/{model}/reject", json={"reason": "wrong arm"}
    ),
    "model approved anew": lambda http, _code, _key, model: http.post(f"/v1/models/{model}/approve", json={}),
    "limits lowered": lambda http, code, _key, _model: http.put(
        f"/v1/participants/{code}/profile", json={"current_ma": 5}
    ),
}
RIGHTS = ("key revoked", "model rejected", "model approved anew")


@pytest.mark.parametrize("what", list(CHANGES))
def test_what_a_trial_rests_on_is_looked_at_again_until_its_first_pulse(
    service: Service, client: httpx.Client, participant: str, approved: str, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """The change is answered only once the rig has been told: it withdraws what has not begun (tests/rig).

    Limits wait in turn for the rig's answer to the start; then the rig is told before they are answered.
    """
    key, controller = key_of(service, client, participant)
    held, begin = Held(), service.rig._on_start

    async def slowly(request: Any) -> Any:
        await asyncio.to_thread(held.wait)
        return await begin(request)

    monkeypatch.setattr(service.rig, "_on_start", slowly)
    with ThreadPoolExecutor(2) as pool:
        asked = pool.submit(controller.post, "/v1/tests", json={"participant": participant, **TRIAL}, timeout=30)
        assert held.reached.wait(20)
        change = pool.submit(CHANGES[what], client, participant, key, approved)
        if what == "limits lowered":
            held.free.set()
        assert change.result().status_code in (200, 204)
        told = list(service.rig.withdrawn)
        held.free.set()
        test = asked.result()
    assert len(told) == 1 and told[0].begun is (what in RIGHTS)
    assert told[0].test_id == service.rig.last_plan.test_id, test.text


def test_a_trial_that_was_planned_with_another_model_is_not_played(
    service: Service, client: httpx.Client, participant: str, approved: str
) -> None:
    _key, controller = key_of(service, client, participant)
    tag = controller.get(f"/v1/participants/{participant}/model").headers["etag"]
    another = run_test(client, participant)["model_id"]
    assert client.post(f"/v1/models/{another}/approve", json={}).is_success
    body, starts = {"participant": participant, **TRIAL}, service.rig.starts
    for head in ({"If-Match": tag}, {"If-Match": '"1"'}):
        refused = controller.post("/v1/tests", json=body, headers=head)
        assert refused.status_code == 412 and refused.json()["type"] == "/problems/changed-meanwhile"
    assert controller.post("/v1/tests", json=body, auth=None).status_code == 428
    assert service.rig.starts == starts
    assert controller.post("/v1/tests", json=body).status_code == 202
    assert approved != another


def test_a_rearm_that_a_stop_overtakes_is_not_done(service: Service, client: httpx.Client) -> None:
    """The re-arm waits while the database is busy; a stop is pressed and confirmed; then the re-arm arrives."""
    assert client.post("/v1/stop", json={"reason": "first"}).is_success
    seen = client.get("/v1/rig").headers["etag"]
    store = service.context.store
    with ThreadPoolExecutor(1) as pool:
        with store.write():
            asked = pool.submit(client.post, "/v1/rearm", headers={"If-Match": seen}, timeout=30)
            assert client.post("/v1/stop", json={"reason": "pain"}, timeout=30).is_success
        answer = asked.result()
    assert answer.status_code == 412 and service.rig.state == "latched"
    (change,) = answer.json()["changes"]
    assert change["action"] == "latched" and change["new"] == service.rig.reason
    assert answer.headers["etag"].strip('"') == service.rig.latch != seen.strip('"')
    assert answer.json()["detail"] == f"{service.rig.reason}; look, then re-arm", "and no entry without a name"


# ---- a site, another's recording, a result that could not be stored -------------------------------------------------


def test_a_model_belongs_to_its_site_and_so_do_its_keys(service: Service, client: httpx.Client, participant: str):
    at = f"/v1/participants/{participant}"
    for site in (
        {"side": "left", "muscle": "biceps brachii"},
        {"side": "left", "muscle": "biceps brachii", "placement": "B"},
    ):
        assert client.put(f"{at}/muscle", json=site).is_success
    model = run_test(client, participant)["model_id"]
    assert client.post(f"/v1/models/{model}/approve", json={}).is_success
    _key, controller = key_of(service, client, participant)
    assert client.get(f"{at}/model").status_code == 200
    others = ({"side": "right"}, {"muscle": "triceps brachii"}, {"placement": "C"}, {"placement": None})
    for other in others:
        assert client.put(f"{at}/muscle", json={**site, **other}).is_success
        assert client.get(f"{at}/model").status_code == 404
        assert controller.get(f"{at}/model").status_code == 403
        assert controller.post("/v1/tests", json={"participant": participant, **TRIAL}).status_code in (403, 412, 428)
        refused = client.post(f"/v1/models/{model}/approve", json={})
        assert refused.status_code == 409 and "left biceps brachii B" in refused.json()["detail"]
    assert client.put(f"{at}/muscle", json=site).is_success
    assert controller.get(f"{at}/model").status_code == 200
    assert service.rig.starts == 1


def test_a_recording_of_somebody_else_is_taken_in_by_a_decision_only(
    service: Service, client: httpx.Client, participant: str
) -> None:
    recording = run_test(client, participant)["recording_id"]
    data = client.get(f"/v1/recordings/{recording}").content
    assert client.post("/v1/participants", json={"code": "P018"}).is_success
    there = "/v1/participants/P018/recordings"
    refused = client.post(there, content=data)
    assert refused.status_code == 409 and refused.json()["of"] == participant
    operator = service.client(service.token("operator", "run-test", "read-model"))
    assert operator.post(there, content=data, params={"of": participant}).status_code == 409
    assert client.get("/v1/participants/P018/models").json() == []
    taken = client.post(there, content=data, params={"of": participant})
    assert taken.status_code == 201, taken.text
    entry = next(one for one in client.get("/v1/audit").json()["entries"][::-1] if one["action"] == "upload recording")
    assert (entry["detail"]["participant"], entry["detail"]["of"]) == ("P018", participant)
    as_csv = client.get(f"/v1/recordings/{taken.json()['recording_id']}/csv").content
    assert as_csv


def test_a_calibration_that_could_not_be_stored_is_stored_by_finishing_again(
    service: Service, client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    at = f"/v1/participants/{participant}/calibration"
    client.post(at, json={})
    mark_all(client)
    store = calibrations._store
    monkeypatch.setattr(calibrations, "_store", Mock(side_effect=OperationalError("is locked", None, Exception())))
    version = client.get(at).headers["etag"]
    assert client.post(f"{at}/finish", headers={"If-Match": version}).status_code == 503
    monkeypatch.setattr(calibrations, "_store", store)
    page = client.get(f"/participants/{participant}/calibration", headers={"Accept": "text/html"}).text
    assert "waits to be stored" in page
    done = client.post(f"{at}/finish", headers={"If-Match": version})
    assert done.status_code == 200 and done.json()["profile"]["max_pulse_width_us"] > 0
    assert client.get(f"/v1/participants/{participant}").json()["profile"]["motor_pulse_width_us"] is not None
    assert service.rig.calibrated is None

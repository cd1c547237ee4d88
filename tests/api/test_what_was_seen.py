"""What a stranger found of decisions on what was not seen: each stays mended."""

from __future__ import annotations

import re
from typing import Any

import httpx
import pytest

from api.client.errors import Conflict
from api.client.rest import Client
from api.errors import ApiError
from rig.messages import WithdrawRequest
from tests.api.conftest import Service, run_test, soon
from tests.api.test_access import csrf, signed_in
from tests.api.test_forms import fields, yes
from tests.api.test_overtaken import TRIAL, key_of

HOME = "/v1/participants/P017"
PAGE = "/participants/P017"


def playing(service: Service, client: httpx.Client, code: str) -> str:
    """A controller's trial plays; the public id of its key."""
    key, controller = key_of(service, client, code)
    service.rig.speed = 0.2
    assert controller.post("/v1/tests", json={"participant": code, **TRIAL}).status_code == 202
    return key


def test_a_trial_ends_with_the_right_of_who_made_its_key(
    service: Service, client: httpx.Client, participant: str, approved: str
) -> None:
    maker = service.client(service.token("clin", "approve-model", "run-test", "read-live", "read-model"))
    playing(service, maker_and(client, maker), participant)
    of_maker = next(token["id"] for token in client.get("/v1/tokens").json() if token["name"] == "clin")
    assert client.delete(f"/v1/tokens/{of_maker}").status_code == 204
    assert [request.begun for request in service.rig.withdrawn] == [True] and approved


def maker_and(admin: httpx.Client, maker: httpx.Client) -> Any:
    """Makes keys as the one, and lists tokens as the other."""

    class Both:
        def post(self, *given: Any, **more: Any) -> httpx.Response:
            return maker.post(*given, **more)

        def get(self, *given: Any, **more: Any) -> httpx.Response:
            return admin.get(*given, **more)

    return Both()


def test_a_withdrawal_that_the_rig_does_not_take_is_repeated_and_stops_meanwhile(
    service: Service, client: httpx.Client, participant: str, approved: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = playing(service, client, participant)
    rig, failed = service.app.state.context.rig, list[int]()
    ask = rig.ask

    async def fails_once(message: Any, timeout_s: float | None = None) -> Any:
        if isinstance(message, WithdrawRequest) and not failed:
            failed.append(1)
            raise ApiError(503, "rig-unreachable", "The rig cannot be reached")
        return await ask(message, timeout_s)

    monkeypatch.setattr(rig, "ask", fails_once)
    assert client.post(f"{PAGE}/keys/{key}/revoke").status_code == 303
    soon(lambda: service.rig.stopped_by == "service")
    assert approved and failed


def test_a_token_that_was_renewed_under_its_name_starts_tests(service: Service, client: httpx.Client) -> None:
    client.post("/v1/participants", json={"code": "P017"})
    service.token("lab", "run-test", "read-live")
    old = next(token["id"] for token in client.get("/v1/tokens").json() if token["name"] == "lab")
    client.delete(f"/v1/tokens/{old}")
    lab = service.client(service.token("lab", "run-test", "read-live"))
    assert lab.post("/v1/tests", json={"participant": "P017"}).status_code == 202


def test_limits_that_were_typed_and_a_start_are_one_way(
    service: Service, client: httpx.Client, participant: str
) -> None:
    with signed_in(service) as tab:
        asked = tab.post(f"{PAGE}/tests", data={**fields(tab), "current_ma": "19"})
        assert yes(tab, asked).headers["location"].startswith("/tests/")
    assert service.rig.last_plan.profile.current_ma == 19


def test_a_form_that_comes_back_for_want_of_something_is_as_old_as_it_was(
    service: Service, client: httpx.Client, participant: str
) -> None:
    with signed_in(service) as tab:
        form = {**fields(tab), "csrf": csrf(tab)}
        client.put(f"{HOME}/profile", json={"max_torque_nm": 12})
        back = tab.post(f"{PAGE}/profile", data={**form, "current_ma": "x"})
        assert back.status_code == 422
        (kept,) = set(re.findall(r'name="seen" value="([^"]+)"', back.text))
        assert kept == form["seen"]
        assert tab.post(f"{PAGE}/profile", data={**form, "seen": kept, "current_ma": "19"}).status_code == 409


def test_a_page_of_another_day_offers_nothing(service: Service, client: httpx.Client, participant: str) -> None:
    with signed_in(service) as tab:
        form = {**fields(tab), "csrf": csrf(tab), "current_ma": "19"}
        form["seen"] = re.sub(r"\.\d{4}-", ".2020-", form["seen"])
        refused = tab.post(f"{PAGE}/profile", data=form)
        assert refused.status_code == 409 and "This page is of 2020-" in refused.text
        assert "all the same" not in refused.text


def test_a_waiting_result_is_let_go_by_who_saw_it(service: Service, client: httpx.Client, participant: str) -> None:
    at = f"{HOME}/calibration"
    client.post(at, json={})
    client.post(f"{at}/step", json={"direction": "up"})
    for threshold in ("sensory", "motor", "comfort"):
        client.post(f"{at}/mark", json={"threshold": threshold})
    found = client.get(at).json()
    service.rig.calibrated = finished(service)
    missing = client.get(at)
    assert missing.status_code == 404 and missing.headers["etag"] == f'"{found["calibration_id"]}.0"'
    for tag, status in (('"C20200101T000000-000000-1.3"', 409), (missing.headers["etag"], 200)):
        sent = client.post(f"{at}/finish", json={"discard": True}, headers={"If-Match": tag})
        assert sent.status_code == status, sent.text
    assert service.rig.calibrated is None


def finished(service: Service) -> Any:
    """As if the service had not heard the rig's answer."""
    from rig import messages as m

    open_one = service.rig.calibration
    assert open_one is not None
    service.rig.calibration, service.rig.state = None, "ready"
    return m.Calibrated(
        calibration_id=open_one.calibration_id, participant=open_one.participant, by="x", result=m.CalibrationResult()
    )


def test_a_program_is_held_to_what_it_read(service: Service, client: httpx.Client, participant: str) -> None:
    """A preview forgets nothing; a rejected model keeps no pre-session test from being made."""
    model = run_test(client, participant)["model_id"]
    client.post(f"/v1/models/{model}/approve", json={})
    with Client(service.url, service.token("lab", "run-test", "read-live", "read-model")) as lab:
        lab.participant(participant)
        client.put(f"{HOME}/profile", json={"current_ma": 7})
        lab.preview(participant)
        with pytest.raises(Conflict):
            lab.start_test(participant)
        lab.participant(participant)
        lab.approved_model(participant)
        client.post(f"/v1/models/{model}/reject", json={"reason": "wrong arm"})
        assert lab.start_test(participant)["state"] in ("requested", "running")

"""The guided calibration through REST and page: the rig decides, the profile is stored, nothing is sent unasked."""

from __future__ import annotations

import httpx

from tests.api.conftest import Service, wait_done
from tests.api.test_access import csrf, signed_in

WHERE = "/v1/participants/P017/calibration"


def test_steps_and_marks_become_the_profile_of_the_day(
    client: httpx.Client, service: Service, participant: str
) -> None:
    assert client.get(WHERE).status_code == 404
    opened = client.post(WHERE, json={"current_ma": 18, "step_us": 10})
    assert opened.status_code == 201 and opened.json()["pulse_width_us"] == 0 and not opened.json()["playing"]
    early = client.post(f"{WHERE}/mark", json={"threshold": "sensory"})
    assert early.status_code == 422 and "Step up first" in early.json()["detail"]
    for threshold in ("sensory", "motor", "comfort"):
        assert client.post(f"{WHERE}/step", json={"direction": "up"}).status_code == 202
        refused = client.post(f"{WHERE}/finish")
        assert refused.status_code == 422 and threshold in refused.json()["detail"]
        client.post(f"{WHERE}/mark", json={"threshold": threshold})
    profile = client.post(f"{WHERE}/finish").json()["profile"]
    assert [profile[f"{name}_pulse_width_us"] for name in ("sensory", "motor", "max")] == [10, 20, 30]
    assert client.get("/v1/participants/P017").json()["profile"] == profile
    test = client.post("/v1/tests", json={"participant": participant})
    assert test.status_code == 202 and service.rig.plan is not None
    assert service.rig.plan.profile.motor_pulse_width_us == 20
    wait_done(client, test.json()["id"])
    actions = [entry["action"] for entry in client.get("/v1/audit").json()["entries"]]
    assert {"begin calibration", "mark motor", "finish calibration"} <= set(actions)


def test_limits_are_the_rigs_and_discarding_keeps_the_old_profile(client: httpx.Client, participant: str) -> None:
    before = client.get("/v1/participants/P017").json()["profile"]
    client.post(WHERE)
    answers = [client.post(f"{WHERE}/step", json={"direction": "up"}) for _ in range(5)]
    assert [answer.status_code for answer in answers] == [202] * 4 + [422]
    assert "above the hard limit" in answers[-1].json()["detail"]
    assert client.post(f"{WHERE}/finish", json={"discard": True}).json()["profile"] is None
    assert client.get("/v1/participants/P017").json()["profile"] == before


def test_words_that_do_not_hold_are_refused_before_the_rig_hears_of_them(
    client: httpx.Client, service: Service, participant: str
) -> None:
    for body in ({"step_us": 26}, {"current_ma": -1}, {"current_ma": "NaN"}, {"train_s": 3}, {"pain": 1}):
        assert client.post(WHERE, json=body).status_code == 422, body
    assert service.rig.calibration is None
    assert client.post("/v1/participants/P9/calibration").status_code == 404


def test_no_calibration_during_a_test(client: httpx.Client, service: Service, participant: str) -> None:
    service.rig.speed = 4.0
    client.post("/v1/tests", json={"participant": participant})
    refused = client.post(WHERE)
    assert refused.status_code == 409 and refused.json()["holder"]["participant"] == participant


def test_sequence_is_played_and_nothing_is_identified(client: httpx.Client, service: Service, participant: str) -> None:
    segments = [{"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": [0, 100, 0]}}]
    body = {"participant": participant, "kind": "sequence", "segments": segments, "max_torque_nm": 5}
    started = client.post("/v1/tests", json=body)
    assert started.status_code == 202 and service.rig.plan is not None and service.rig.plan.max_torque_nm == 5
    document = wait_done(client, started.json()["id"])
    assert document["state"] == "completed" and document["model_id"] is None
    assert client.get(document["recording_url"]).status_code == 200


def test_whole_calibration_by_plain_forms(service: Service, participant: str) -> None:
    page = "/participants/P017/calibration"
    with signed_in(service) as browser:
        token = {"csrf": csrf(browser)}
        assert "Begin the calibration" in browser.get(page).text
        assert browser.post(page, data={**token, "current_ma": "x", "step_us": "10"}).status_code == 422
        assert browser.post(page, data={**token, "current_ma": "20", "step_us": "10"}).status_code == 303
        for threshold in ("sensory", "motor", "comfort"):
            browser.post(f"{page}/step/up", data=token)
            browser.post(f"{page}/mark/{threshold}", data=token)
        assert "Still to be marked" not in browser.get(page).text
        assert browser.post(f"{page}/step/sideways", data=token).status_code == 422
        led = browser.post(f"{page}/finish", data=token)
        assert led.headers["location"] == "/participants/P017"
        assert "felt at 10 µs, moves at 20 µs" in browser.get("/participants/P017").text

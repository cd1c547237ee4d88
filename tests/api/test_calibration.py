"""The guided calibration through REST and page: the rig decides, the profile is stored, nothing is sent unasked."""

from __future__ import annotations

import asyncio
import re
import threading
from typing import Any

import httpx
import pytest

from tests.api.conftest import Service, soon, wait_done
from tests.api.forms import Page, press
from tests.api.test_problems import problem
from tests.api.test_profiles import calibrate, mark_all

WHERE = "/v1/participants/P017/calibration"


def test_steps_and_marks_become_the_profile_of_the_day(client: httpx.Client, service: Service, participant: str):
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
    assert test.status_code == 202 and service.rig.last_plan is not None
    assert service.rig.last_plan.profile.motor_pulse_width_us == 20
    wait_done(client, test.json()["id"])
    actions = [entry["action"] for entry in client.get("/v1/audit").json()["entries"]]
    assert {"begin calibration", "mark motor", "finish calibration"} <= set(actions)


def test_limits_are_the_rigs_and_discarding_keeps_the_old_profile(client: httpx.Client, participant: str) -> None:
    before = client.get("/v1/participants/P017").json()["profile"]
    client.post(WHERE)
    answers = [client.post(f"{WHERE}/step", json={"direction": "up"}) for _ in range(5)]
    assert [answer.status_code for answer in answers] == [202] * 4 + [422]
    assert "above the hard limit" in answers[-1].json()["detail"]
    assert client.post(f"{WHERE}/discard").json()["profile"] is None
    assert client.get("/v1/participants/P017").json()["profile"] == before


def test_no_calibration_during_a_test(client: httpx.Client, service: Service, participant: str) -> None:
    service.rig.speed = 0.5
    client.post("/v1/tests", json={"participant": participant})
    refused = client.post(WHERE)
    assert refused.status_code == 409 and refused.json()["holder"]["participant"] == participant


def test_sequence_is_played_and_nothing_is_identified(client: httpx.Client, service: Service, participant: str) -> None:
    segments = [{"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": [0, 100, 0]}}]
    body = {"participant": participant, "kind": "sequence", "segments": segments, "profile": {"max_torque_nm": 5}}
    started = client.post("/v1/tests", json=body)
    assert started.status_code == 202 and service.rig.last_plan is not None and service.rig.last_plan.max_torque_nm == 5
    document = wait_done(client, started.json()["id"])
    assert document["state"] == "completed" and document["model_id"] is None
    assert client.get(document["recording_url"]).status_code == 200


PAGE = "/participants/P017/calibration"


def test_last_times_marks_stand_beside_todays(
    service: Service, pages: httpx.Client, client: httpx.Client, participant: str
):
    calibrate(client)
    assert "felt at 10 µs, moves at 20 µs, comfortable up to 30 µs" in pages.get(PAGE).text
    press(pages, PAGE, "/calibration")
    marks = pages.get(PAGE).text.partition('<table class="marks">')[2].partition("</table>")[0]
    assert re.findall(r"(\d+)\s*µs", marks) == ["10", "20", "30"]
    assert service.rig.asked is not None and service.rig.asked.large_steps
    assert service.rig.asked.last.sensory_pulse_width_us == 10


# ---- limits that change while one is open -------------------------------------------------------------------


PROFILE = "/v1/participants/P017/profile"
LOWER = {"current_ma": 5, "max_pulse_width_us": 60, "max_torque_nm": 5}


def up(client: httpx.Client) -> httpx.Response:
    return client.post(f"{WHERE}/step", json={"direction": "up"})


def test_lowered_limits_end_an_open_calibration_and_stay(client: httpx.Client, service: Service, participant: str):
    for asked in ({"current_ma": 19.5}, {"max_torque_nm": 29}, {"max_pulse_width_us": 290}):
        client.post(WHERE, json={"current_ma": 19})
        assert up(client).status_code == 202 and client.put(PROFILE, json=asked).status_code == 200
        assert up(client).status_code == 409, asked
        client.post(f"{WHERE}/discard")
    client.post(WHERE, json={"current_ma": 19})
    mark_all(client)
    lowered = client.put(PROFILE, json=LOWER)
    assert lowered.status_code == 200 and "sends no further train" in lowered.json()["meanwhile"]
    assert service.rig.calibration is not None
    trains = service.rig.calibration.trains
    for path, body in [("step", {"direction": d}) for d in ("up", "repeat", "down")] + [
        ("mark", {"threshold": "comfort"}), ("finish", {})
    ]:  # fmt: skip
        refused = problem(client.post(f"{WHERE}/{path}", json=body), 409)
        assert "Discard it and begin anew" in refused["detail"], path
    assert service.rig.calibration.trains == trains, "not one train more"
    assert "Discard it" in client.get(WHERE).json()["outdated"]
    kept = lowered.json()["profile"]
    assert client.get("/v1/participants/P017").json()["profile"] == kept
    assert client.post(f"{WHERE}/discard").status_code == 200
    assert client.get("/v1/participants/P017").json()["profile"] == kept
    anew = client.post(WHERE)
    assert anew.status_code == 201 and not anew.json()["outdated"] and up(client).status_code == 202


def test_what_changes_no_limit_leaves_the_calibration_open(client: httpx.Client, participant: str) -> None:
    client.post("/v1/participants", json={"code": "P018"})
    client.post(WHERE)
    assert client.put(PROFILE, json={"current_ma": 20}).status_code == 200
    assert client.put("/v1/participants/P018/profile", json={"current_ma": 5}).json()["meanwhile"] == ""
    assert up(client).status_code == 202


@pytest.mark.parametrize("end", ["", "-999999", "-{}0", "-1x"])
def test_one_that_the_service_did_not_begin_is_discarded_alone(
    client: httpx.Client, service: Service, participant: str, end: str
) -> None:
    """The version is part of the id that the rig tells, so it outlives this service; no version, no train."""
    client.post(WHERE)
    known = service.rig.calibration
    assert known is not None
    stamp, drawn, version = known.calibration_id.split("-")
    other = f"{stamp}-{drawn}{end.format(version)}"
    service.rig.calibration = known.model_copy(update={"calibration_id": other})
    assert problem(up(client), 409) and problem(client.post(f"{WHERE}/finish"), 409)
    assert client.post(f"{WHERE}/discard").status_code == 200


def test_a_change_waits_for_the_step_on_its_way_and_the_next_one_sees_it(
    client: httpx.Client, service: Service, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once a change is answered, no train begins with what was before."""
    client.post(WHERE)
    asked, go = threading.Event(), threading.Event()
    order: list[str] = []
    play: Any = service.rig._on_calibrate_step

    async def slow(request: Any) -> Any:
        asked.set()
        await asyncio.to_thread(go.wait, 20)
        order.append("train")
        return await play(request)

    monkeypatch.setattr(service.rig, "_on_calibrate_step", slow)

    def change() -> None:
        with service.client() as other:
            order.append(str(other.put(PROFILE, json=LOWER).status_code))

    stepping, changing = threading.Thread(target=up, args=[client]), threading.Thread(target=change)
    stepping.start()
    assert asked.wait(20)
    changing.start()
    changing.join(0.3)  # it would have been answered by now, had it not waited
    go.set()
    stepping.join(20), changing.join(20)
    assert order == ["train", "200"]
    assert up(client).status_code == 409 and order == ["train", "200"]


def test_the_page_says_that_it_goes_no_further(client: httpx.Client, pages: httpx.Client, participant: str) -> None:
    press(pages, PAGE, "/calibration")
    press(pages, PAGE, "/step")
    assert "A calibration is open." in pages.get("/participants/P017").text
    assert client.put(PROFILE, json=LOWER).status_code == 200
    shown = pages.get(PAGE).text
    assert "P017 now has other limits (5 mA, 60 µs, 5 N·m)" in shown
    calls = [
        (call, button) for form in Page(shown).forms for call, _, button in form.calls() if "/calibration/" in call
    ]
    assert len(calls) == 9
    assert [call for call, button in calls if button and not button.disabled] == [f"POST {WHERE}/discard"]
    for call, answer in (("/step", 409), ("/finish", 409), ("/discard", 200)):
        assert press(pages, PAGE, call).status_code == answer


def test_lowered_during_a_test_says_that_it_holds_from_the_next_one(
    client: httpx.Client, service: Service, pages: httpx.Client, participant: str
) -> None:
    service.rig.speed = 2.0
    started = client.post("/v1/tests", json={"participant": participant}).json()["id"]
    words = "hold from the next test on"
    assert words in client.put(PROFILE, json=LOWER).json()["meanwhile"]
    assert words in pages.get("/participants/P017").text
    client.post("/v1/stop")
    wait_done(client, started)
    assert client.put(PROFILE, json=LOWER).json()["meanwhile"] == ""


@pytest.fixture
def shown(client: httpx.Client, pages: httpx.Client, participant: str) -> str:
    """The calibration's page after one train."""
    client.post(WHERE)
    up(client)
    return pages.get(PAGE).text


def trains(service: Service) -> int:
    assert service.rig.calibration is not None
    return len(service.rig.calibration.trains)


def at_once(service: Service, pressed: Any, count: int = 2) -> list[httpx.Response]:
    """Press so often; all requests stand at the turn before the first of them gets it."""
    context = service.context
    turn, loop = context.limits_lock, context.rig._task.get_loop()
    service.run(turn.acquire())
    answers: list[httpx.Response] = []
    pressing = [threading.Thread(target=lambda: answers.append(pressed())) for _ in range(count)]
    for thread in pressing:
        thread.start()
    soon(lambda: len(turn._waiters or ()) >= count, 20)
    loop.call_soon_threadsafe(turn.release)
    for thread in pressing:
        thread.join(20)
    return answers


def test_two_presses_at_once_send_exactly_one_train(service: Service, pages: httpx.Client, shown: str) -> None:
    answers = at_once(service, lambda: press(pages, "", "/step", html=shown))
    assert sorted(answer.status_code for answer in answers) == [202, 412] and trains(service) == 2
    (late,) = [answer.text for answer in answers if answer.status_code == 412]
    assert "Another train was sent after this page was shown, or another mark was set. Nothing was done now." in late


def test_nothing_pressed_before_a_train_counts_while_it_is_on_its_way(
    service: Service, pages: httpx.Client, shown: str
) -> None:
    service.rig_thread.become("running")
    for call in ("/step", "/mark", "/finish"):
        answer = press(pages, "", call, html=shown)
        assert answer.status_code == 412 and "Another train was sent" in answer.text, call
    assert trains(service) == 1 and not service.rig.calibration.marks_us


def test_a_page_that_shows_not_all_marks_finishes_nothing(
    client: httpx.Client, service: Service, pages: httpx.Client, shown: str
) -> None:
    for threshold in ("sensory", "motor", "comfort"):
        client.post(f"{WHERE}/mark", json={"threshold": threshold})
    assert press(pages, "", "/finish", html=shown).status_code == 412
    assert press(pages, PAGE, "/finish").status_code == 200

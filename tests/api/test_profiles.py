"""Limits over REST: what is left out stays, nothing is read as a number that is none, nobody is overrun."""

from __future__ import annotations

import concurrent.futures
import json
import math
from collections import Counter
from typing import Any

import httpx
import pytest
from pydantic import BaseModel, ValidationError

from stimrig.api.errors import ApiError
from stimrig.api.sessions import profiles
from stimrig.api.sessions.requests import CalibrationIn, ParticipantIn, ProfileIn, TestIn, limits_of
from stimrig.api.store.tables import Participant
from stimrig.rig.limits import FINEST
from tests.api.conftest import Service, wait_done
from tests.api.test_problems import problem

P = "/v1/participants/P017"
TIGHT = {"current_ma": 12.0, "max_pulse_width_us": 150.0, "max_torque_nm": 20.0}


@pytest.fixture
def tight(client: httpx.Client) -> dict[str, float]:
    assert client.post("/v1/participants", json={"code": "P017", "profile": TIGHT}).status_code == 201
    return TIGHT


def limits(client: httpx.Client) -> dict[str, Any]:
    profile = client.get(P).json()["profile"]
    return {name: profile[name] for name in profiles.LIMITS}


def mark_all(client: httpx.Client, code: str = "P017") -> None:
    """The three thresholds of the open calibration, a step each."""
    for threshold in ("sensory", "motor", "comfort"):
        for what, body in (("step", {"direction": "up"}), ("mark", {"threshold": threshold})):
            answer = client.post(f"/v1/participants/{code}/calibration/{what}", json=body)
            assert answer.is_success, answer.text


def calibrate(client: httpx.Client, **asked: Any) -> dict[str, Any]:
    """Sensory at 10 µs, motor at 20, comfort at 30."""
    assert client.post(f"{P}/calibration", json=asked).status_code == 201
    mark_all(client)
    return client.post(f"{P}/calibration/finish").json()["profile"]


def test_what_is_left_out_keeps_its_value(client: httpx.Client, tight: dict[str, float]) -> None:
    for sent in ({"current_ma": 10}, {}, {"max_torque_nm": 10}):
        assert client.put(f"{P}/profile", json=sent).status_code == 200
        tight = {**tight, **sent}
        assert limits(client) == tight


def test_first_limits_are_whole_or_none(client: httpx.Client) -> None:
    refused = problem(client.post("/v1/participants", json={"code": "P018", "profile": {"current_ma": 10}}), 422)
    assert "Send max_pulse_width_us, max_torque_nm, too" in refused["detail"]
    assert client.get("/v1/participants/P018").status_code == 404


NO_NUMBERS = [
    "true", "false", '"20"', '"9,5"', "null", "NaN", "Infinity", "1e999", "0", "-1", "[20]", "{}", "1e-320", "0.04",
]  # fmt: skip


@pytest.mark.parametrize("text", NO_NUMBERS)
def test_what_is_no_number_is_refused_everywhere(text: str) -> None:
    def refused(body: type[BaseModel], **fields: Any) -> None:
        with pytest.raises(ValidationError):
            body.model_validate(fields)

    value = json.loads(text)
    for name in TIGHT:
        refused(ProfileIn, **{name: value})
        refused(ParticipantIn, code="P019", profile={**TIGHT, name: value})
        refused(TestIn, participant="P017", profile={name: value})
    refused(TestIn, participant="P017", pulse_rate_hz=value)
    for name in ("step_us", "train_s", "current_ma", "max_torque_nm"):
        if value is not None or name not in TIGHT:
            refused(CalibrationIn, **{name: value})


@pytest.mark.parametrize(
    ("method", "path"),
    [("PUT", f"{P}/profile"), ("POST", "/v1/tests"), ("POST", "/v1/preview"), ("POST", f"{P}/calibration")],
)
def test_each_route_takes_numbers_alone(client: httpx.Client, tight: dict[str, float], method: str, path: str) -> None:
    sent = {"current_ma": True}
    body = sent if path.startswith(P) else {"participant": "P017", "profile": sent}
    assert problem(client.request(method, path, json=body), 422)["errors"] and limits(client) == tight
    slip = {"current": 10} if path.startswith(P) else {"participant": "P017", "current": 10}
    assert "current" in problem(client.request(method, path, json=slip), 422)["detail"]


@pytest.mark.parametrize(("name", "least"), [("current_ma", 0.5), ("max_pulse_width_us", 1), ("max_torque_nm", 0.1)])
def test_a_limit_begins_where_a_stimulator_does(name: str, least: float) -> None:
    with pytest.raises(ValidationError, match=f"greater than or equal to {least:g}"):
        ProfileIn.model_validate({name: least * 0.99})
    assert ProfileIn.model_validate({name: least}).sent() == {name: least}


def test_the_least_limits_are_the_stimulators_finest_steps() -> None:
    least = {name: limit.lowest for name, limit in profiles.LIMITS.items()}
    assert (least["current_ma"], least["max_pulse_width_us"]) == (FINEST.current_ma, FINEST.shortest_us)


@pytest.mark.parametrize("form", ["utf-8-sig", "utf-16-le", "utf-32"])
def test_what_is_not_in_plain_utf_8_is_refused_at_the_door(
    client: httpx.Client, tight: dict[str, float], form: str
) -> None:
    """The route's reader would guess the form, and see a name twice that the door does not."""
    body = '{"current_ma": 1, "current_ma": 5}'.encode(form)
    refused = problem(client.put(f"{P}/profile", content=body, headers={"content-type": "application/json"}), 400)
    words = "byte-order mark" if form == "utf-8-sig" else "in UTF-8"
    assert words in refused["detail"] and "\n" not in refused["detail"] and limits(client) == tight


def test_what_this_rig_would_refuse_is_refused_at_once(client: httpx.Client, tight: dict[str, float]) -> None:
    """60 mA and 20 µC a phase by the rig file; one alone is not looked at, the other stays the participant's."""
    assert "60 mA" in problem(client.put(f"{P}/profile", json={"current_ma": 61}), 422)["detail"]
    both = {"current_ma": 60, "max_pulse_width_us": 400}
    assert "24 µC" in problem(client.put(f"{P}/profile", json=both), 422)["detail"]
    assert limits(client) == tight
    assert client.put(f"{P}/profile", json={"current_ma": 60}).status_code == 200


def test_of_many_at_once_one_wins_and_the_others_are_told(client: httpx.Client, tight: dict[str, float]) -> None:
    seen = {"If-Match": client.get(P).headers["etag"]}
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        bodies = [{"current_ma": 5 + number / 10} for number in range(16)]
        codes = Counter(pool.map(lambda b: client.put(f"{P}/profile", json=b, headers=seen).status_code, bodies))
    assert codes == {200: 1, 412: 15}


@pytest.mark.parametrize(
    ("asked", "words"),
    [({"current_ma": 10, "max_pulse_width_us": 125}, ""), ({"current_ma": 18.5}, "above the calibrated 18 mA"),
     ({"max_torque_nm": 13}, "above the calibrated 12 N·m"),
     ({"max_pulse_width_us": 221}, "above the calibrated 220 µs"),
     ({"max_pulse_width_us": 119}, "moves from 120 µs on")],
)  # fmt: skip
def test_a_tighter_limit_keeps_the_calibration(asked: dict[str, float], words: str) -> None:
    profile, voids = profiles.changed(CALIBRATED, asked)
    assert words in voids and bool(voids) == bool(words)
    assert profile == {**CALIBRATED, **asked, **(dict.fromkeys(profiles.CALIBRATION_FIELDS) if words else {})}


def test_a_calibration_is_lost_knowingly_alone(client: httpx.Client, service: Service, tight: dict[str, float]) -> None:
    """A confirmation is one person's, of one change and one version."""

    def put(token: str, current_ma: float = 12.5, by: httpx.Client = client) -> httpx.Response:
        return by.put(f"{P}/profile", params={"confirm": token}, json={"current_ma": current_ma})

    found, refused = calibrate(client), problem(put(""), 409)
    assert "above the calibrated 12 mA" in refused["detail"] and client.get(P).json()["profile"] == found
    token = refused["confirm"]["token"]
    lab = service.client(service.token("lab", "run-test"))
    assert put(token, 13.0).status_code == 409 == put(token, by=lab).status_code
    assert client.put(f"{P}/muscle", json={"side": "left"}).status_code == 200
    token = problem(put(token), 409)["confirm"]["token"]
    assert put(token).status_code == 200
    profile = client.get(P).json()["profile"]
    assert [profile[name] for name in profiles.CALIBRATION_FIELDS] == [None] * 4 and profile["current_ma"] == 12.5


def test_a_calibration_takes_the_participants_own_limits(
    client: httpx.Client, service: Service, tight: dict[str, float]
) -> None:
    """Not 20 mA and 30 N·m because nothing was said; and what it doesn't look for is kept."""
    service.change(Participant, "P017", profile=lambda old: old | {"rest_between_tests_s": 60.0})
    found = calibrate(client)
    assert (found["current_ma"], found["max_torque_nm"], found["rest_between_tests_s"]) == (12, 20, 60)
    assert client.get(P).json()["profile"] == found


@pytest.mark.parametrize("body", ['{"pulse_width_us": [true]}', '{"pulse_width_us": [10], "pulse_rate_hz": "40"}'])
def test_a_prediction_takes_numbers_alone(shared_client: httpx.Client, body: str) -> None:
    headers = {"content-type": "application/json"}
    assert shared_client.post("/v1/models/none/prediction", content=body, headers=headers).status_code == 422


# ---- the rules themselves -----------------------------------------------------------------------------------


def test_two_small_rises_add_to_a_jump() -> None:
    one = {**TIGHT, "current_ma": 14.0}
    assert profiles.jumps(TIGHT, one) == []
    (words,) = profiles.jumps(TIGHT, {**one, "max_pulse_width_us": 180.0})
    assert words == "The charge of the widest pulse rises from 1.8 to 2.52 µC, 1.4 times as much."
    assert profiles.jumps(TIGHT, {**TIGHT, "current_ma": 15.0}) == [], "a quarter is not more than a quarter"
    assert profiles.jumps(TIGHT, {name: value / 2 for name, value in TIGHT.items()}) == []


def test_a_day_ends_whichever_way_its_end_is_written() -> None:
    profile = {**TIGHT, "set_at_utc": "2026-01-01T08:00:00Z", "expires_at_utc": "2026-01-01T23:00:00Z"}
    assert profiles.calibration(profile, "2026-01-01T22:59:59.999Z") == "valid"
    assert profiles.calibration(profile, "2026-01-01T23:00:00.000Z") == "expired"
    assert profiles.calibration(TIGHT, "2026-01-01T23:00:00Z") == "none"


CALIBRATED = {
    "angle_range_rad": None, "angle_set_at_utc": None,
    "current_ma": 18.0, "max_pulse_width_us": 220.0, "max_torque_nm": 12.0, "sensory_pulse_width_us": 60.0,
    "motor_pulse_width_us": 120.0, "set_at_utc": "2026-01-01T08:00:00Z", "expires_at_utc": "2026-01-01T23:00:00Z",
    "rest_between_tests_s": 60.0,
}  # fmt: skip


def a_test(**fields: Any) -> TestIn:
    return TestIn.model_validate({"participant": "N1", **fields})


@pytest.fixture
def limited(client: httpx.Client) -> str:
    profile = {"current_ma": 18, "max_pulse_width_us": 220, "max_torque_nm": 12}
    assert client.post("/v1/participants", json={"code": "N1", "profile": profile}).status_code == 201
    return "N1"


def test_a_wider_limit_is_refused_and_nothing_starts(client: httpx.Client, service: Service, limited: str) -> None:
    for name, value, words in (
        ("current_ma", 18.5, "18.5 mA is above the participant's 18 mA by 0.5"),
        ("max_pulse_width_us", 221, "221 µs is above the participant's 220 µs by 1"),
        ("max_torque_nm", 30, "30 N·m is above the participant's 12 N·m by 18"),
    ):
        body = {"participant": limited, "profile": {name: value}}
        for path in ("/v1/tests", "/v1/preview"):
            refused = problem(client.post(path, json=body), 422)
            assert words in refused["detail"] and refused["errors"][0]["field"] == f"profile.{name}"
    assert service.rig.starts == 0 and client.get("/v1/tests").json() == []


def test_a_narrower_limit_reaches_the_rig(client: httpx.Client, service: Service, limited: str) -> None:
    service.rig.speed = 0.5
    profile = {"current_ma": 10, "max_pulse_width_us": 200, "max_torque_nm": 11}
    test_id = client.post("/v1/tests", json={"participant": limited, "profile": profile}).json()["id"]
    plan = service.rig.last_plan
    assert plan is not None
    assert (plan.profile.current_ma, plan.profile.max_pulse_width_us, plan.profile.max_torque_nm) == (10, 220, 12)
    assert (plan.max_pulse_width_us, plan.max_torque_nm) == (200, 11)
    assert client.post("/v1/stop").status_code == 200
    wait_done(client, test_id)
    assert client.get(f"/v1/participants/{limited}").json()["profile"]["current_ma"] == 18, "for that test alone"


def test_a_narrower_limit_leaves_the_calibration_whole() -> None:
    """Narrower than the motor threshold even: the calibration stays what a person found, and its day stays its day."""
    found = limits_of(a_test(profile=ProfileIn(current_ma=10, max_pulse_width_us=100, max_torque_nm=5)), CALIBRATED)
    assert found["profile"].model_dump() == {**CALIBRATED, "current_ma": 10}
    assert (found["max_pulse_width_us"], found["max_torque_nm"]) == (100, 5)
    unasked = limits_of(a_test(), CALIBRATED)
    assert unasked["profile"].model_dump() == CALIBRATED
    assert unasked["max_pulse_width_us"] is None is unasked["max_torque_nm"]


@pytest.mark.parametrize("own", [None, {}, {"current_ma": 18.0, "max_pulse_width_us": 220.0}])
def test_what_neither_says_is_not_made_up(own: dict[str, Any] | None) -> None:
    """A participant without limits, or with some alone: no width or torque of a default comes in their place."""
    with pytest.raises(ApiError, match="max_torque_nm"):
        limits_of(a_test(profile=ProfileIn(current_ma=10)), own)


def test_what_is_no_number_is_wider() -> None:
    asked = ProfileIn.model_construct(_fields_set={"current_ma"}, current_ma=math.nan)
    with pytest.raises(Exception, match="Wider than"):
        limits_of(TestIn.model_construct(profile=asked), CALIBRATED)

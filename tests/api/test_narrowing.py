"""A test's own limits narrow the participant's; they never widen or replace them."""

from __future__ import annotations

import math
from typing import Any

import httpx
import pytest

from stimrig.api.errors import ApiError
from stimrig.api.sessions.limits import limits_of
from stimrig.api.sessions.requests import ProfileIn, TestIn
from tests.api.conftest import Service, wait_done
from tests.api.test_problems import problem

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
    body = {"participant": limited, "profile": {"current_ma": 10}, "max_pulse_width_us": 200, "max_torque_nm": 11}
    test_id = client.post("/v1/tests", json=body).json()["id"]
    plan = service.rig.last_plan
    assert plan is not None
    assert (plan.profile.current_ma, plan.profile.max_pulse_width_us, plan.profile.max_torque_nm) == (10, 220, 12)
    assert (plan.max_pulse_width_us, plan.max_torque_nm) == (200, 11)
    assert client.post("/v1/stop").status_code == 200
    wait_done(client, test_id)
    assert client.get(f"/v1/participants/{limited}").json()["profile"]["current_ma"] == 18, "for that test alone"


def test_a_narrower_limit_leaves_the_calibration_whole() -> None:
    """Narrower than the motor threshold even: the calibration stays what a person found, and its day stays its day."""
    asked = ProfileIn(current_ma=10, max_pulse_width_us=100)
    found = limits_of(a_test(profile=asked, max_pulse_width_us=150, max_torque_nm=5), CALIBRATED)
    assert found["profile"].model_dump() == {**CALIBRATED, "current_ma": 10}
    assert (found["max_pulse_width_us"], found["max_torque_nm"]) == (100, 5)


def test_without_a_profile_of_the_request_the_participants_holds() -> None:
    found = limits_of(a_test(), CALIBRATED)
    assert found["profile"].model_dump() == CALIBRATED
    assert found["max_pulse_width_us"] is None and found["max_torque_nm"] is None


@pytest.mark.parametrize("own", [None, {}, {"current_ma": 18.0, "max_pulse_width_us": 220.0}])
def test_what_neither_says_is_not_made_up(own: dict[str, Any] | None) -> None:
    """A participant without limits, or with some alone: no width or torque of a default comes in their place."""
    with pytest.raises(ApiError, match="max_torque_nm"):
        limits_of(a_test(profile=ProfileIn(current_ma=10)), own)


def test_what_is_no_number_is_wider() -> None:
    asked = ProfileIn.model_construct(_fields_set={"current_ma"}, current_ma=math.nan)
    body = TestIn.model_construct(profile=asked, max_pulse_width_us=None, max_torque_nm=None)
    with pytest.raises(Exception, match="Wider than"):
        limits_of(body, CALIBRATED)

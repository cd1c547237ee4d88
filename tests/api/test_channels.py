"""A participant's channels on a rig of several: limits and sites of each, a calibration and a test of both."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import httpx
import pytest

from stimrig.rig.channels import RigChannel
from stimrig.rig.limits import HARD_LIMITS, SUM_LIMITS, for_plan
from stimrig.rig.messages import ChannelPlan, Profile, TestPlan
from stimrig.rig.plan import build
from tests.api.conftest import Service, csrf, own_service, signed_in, soon, wait_done

TWO = ["biceps", "triceps"]
OWN: dict[str, Any] = {"current_ma": 12.0, "max_pulse_width_us": 250.0, "max_torque_nm": 20.0}
PERSON = "/v1/participants/P017"
TRICEPS = f"{PERSON}/channels/triceps"


@pytest.fixture
def two(service: Service) -> Iterator[httpx.Client]:
    """A client; the rig has two channels, the participant limits on the first."""
    service.rig.channels = TWO
    with service.client() as http:
        made = http.post("/v1/participants", json={"code": "P017", "side": "left", "muscle": "biceps brachii"})
        assert made.status_code == 201
        settled(service, http)
        yield http


def settled(service: Service, http: httpx.Client) -> None:
    """The service knows that the rig has two channels."""
    service.rig.become("ready")
    soon(lambda: len((http.get("/v1/rig").json()["stimulator"]).get("channels") or []) == 2)


def test_who_has_one_channel_sees_none(client: httpx.Client, participant: str) -> None:
    assert "channels" not in client.get(PERSON).json()
    refused = client.put(f"{TRICEPS}/profile", json=OWN)
    assert refused.status_code == 404 and "one channel" in refused.json()["detail"]
    refused = client.post("/v1/tests", json={"participant": participant, "kind": "muscles"})
    assert refused.status_code == 409 and refused.json()["type"].endswith("one-channel")


def test_a_further_channel_has_limits_and_a_site_of_its_own(two: httpx.Client) -> None:
    refused = two.put(f"{TRICEPS}/profile", json={"current_ma": 12.0})
    assert refused.status_code == 422 and "max_pulse_width_us" in refused.json()["detail"]
    refused = two.put(f"{TRICEPS}/profile", json={**OWN, "current_ma": 90.0})
    assert refused.status_code == 422 and "rig file" in refused.json()["detail"]
    assert two.put(f"{TRICEPS}/profile", json=OWN).status_code == 200
    site = {"side": "left", "muscle": "triceps brachii", "placement": "B"}
    assert two.put(f"{TRICEPS}/muscle", json=site).status_code == 200
    found = two.get(PERSON).json()
    assert found["channels"] == {"triceps": {**site, "profile": OWN}}
    assert (found["profile"]["current_ma"], found["muscle"]) == (20.0, "biceps brachii")
    assert two.put(f"{TRICEPS}/profile", json={"current_ma": 13.0}).json()["channels"]["triceps"]["profile"] == {
        **OWN, "current_ma": 13.0,
    }  # fmt: skip
    assert two.put(f"{PERSON}/channels/biceps/profile", json={"current_ma": 18.0}).status_code == 200
    assert two.get(PERSON).json()["profile"]["current_ma"] == 18.0, "the first channel is the participant's own"
    assert two.put(f"{PERSON}/channels/soleus/profile", json=OWN).status_code == 404
    told = [entry for entry in two.get("/v1/audit").json()["entries"] if entry["action"] == "set profile"]
    assert [entry["detail"].get("channel") for entry in told] == ["triceps", "triceps", None]


def test_the_plan_is_one_that_the_rig_takes() -> None:
    """Each channel moves alone and with the other, in fitted and in held-out pulses; nothing is beyond its limits."""
    channels = [
        ChannelPlan(name=name, profile=Profile(**{**OWN, "current_ma": 10.0 + k})) for k, name in enumerate(TWO)
    ]
    plan = TestPlan(
        segments=None,
        test_id="T1", participant="P1", kind="muscles", profile=Profile(**OWN),
        channels=channels,
    )  # fmt: skip
    plan.profile = channels[0].profile
    built = build(plan, for_plan({**HARD_LIMITS, **SUM_LIMITS}, plan), [RigChannel(name, "", "", "") for name in TWO])
    seen: set[tuple[str, bool, bool]] = set()
    for part in built.segments:
        rounds = built.pulse_width_us[part.start : part.end].reshape(-1, 2)
        seen.add((part.name, *(rounds.max(axis=0) > 0).tolist()))
        assert rounds.max() <= 250.0
    for name in ("ramp", "validate"):
        assert {(name, True, False), (name, False, True)} <= seen
    assert {("prbs", True, True), ("validate", True, True), ("rest", False, False)} <= seen
    assert 40.0 < built.duration_s < 70.0
    first, second = next(
        built.pulse_width_us[s.start : s.end].reshape(-1, 2).T for s in built.segments if s.name == "prbs"
    )
    assert abs(float(((first > 0) == (second > 0)).mean()) - 0.5) < 0.1, "the two look like each other"


@pytest.mark.parametrize("count", [3, 4, 8])
def test_more_channels_have_such_a_plan_too(count: int) -> None:
    names = [f"c{number}" for number in range(count)]
    channels = [ChannelPlan(name=name, profile=Profile(**{**OWN, "current_ma": 5.0})) for name in names]
    plan = TestPlan(
        segments=None, test_id="T1", participant="P1", kind="muscles", profile=channels[0].profile, channels=channels
    )
    built = build(plan, for_plan({**HARD_LIMITS, **SUM_LIMITS}, plan), [RigChannel(name, "", "", "") for name in names])
    assert (built.pulse_width_us.reshape(-1, count).max(axis=0) > 100.0).all()


def ready(two: httpx.Client) -> None:
    assert two.put(f"{TRICEPS}/profile", json=OWN).status_code == 200


def test_a_test_of_both_muscles_is_previewed_played_and_kept(two: httpx.Client, service: Service) -> None:
    asked = {"participant": "P017", "kind": "muscles"}
    refused = two.post("/v1/tests", json=asked)
    assert refused.status_code == 422 and "no limits on triceps" in refused.json()["detail"]
    ready(two)
    preview = two.post("/v1/preview", json=asked).json()
    doses = [preview["channels"][name]["charge_uc"] for name in TWO]
    assert min(doses) > 0 and preview["torque_time_nms"] is None
    test = two.post("/v1/tests", json=asked).json()
    assert test["planned"]["channels"] == {
        name: {"charge_uc": pytest.approx(dose)} for name, dose in zip(TWO, doses, strict=True)
    }
    done = wait_done(two, test["id"])
    assert done["recording_id"], done
    played: Any = service.rig.last_plan
    assert [one.name for one in played.channels] == TWO
    assert [one.profile.current_ma for one in played.channels] == [20.0, 12.0]
    assert set(done["summary"]["channels"]) == set(TWO)
    with h5py.File(Path(next(service.rig.data.glob("*.h5")))) as file:
        assert [one["name"] for one in json.loads(str(file.attrs["channels"]))] == TWO


def test_limits_stay_with_their_channel_whatever_the_order_in_the_rig_file(two: httpx.Client, service: Service) -> None:
    """A first channel's limits stand by its place: a rig with another first one plays nothing by them."""
    ready(two)
    assert two.put(f"{PERSON}/channels/biceps/profile", json={"current_ma": 18.0}).status_code == 200
    service.rig.channels = TWO[::-1]
    service.rig.become("ready")
    soon(lambda: two.get("/v1/rig").json()["stimulator"]["channels"][0]["name"] == "triceps")
    two.put(f"{PERSON}/channels/biceps/profile", json=OWN)
    for body in ({"kind": "muscles"}, {"kind": "test"}):
        refused = two.post("/v1/tests", json={"participant": "P017", **body})
        assert refused.status_code == 409 and refused.json()["type"].endswith("other-order"), refused.text
    assert two.post(f"{PERSON}/calibration").status_code == 409
    assert service.rig.last_plan is None and set(two.get(PERSON).json()["channels"]) == set(TWO)
    assert two.put(f"{TRICEPS}/muscle", json={"side": "left", "muscle": "triceps brachii"}).status_code == 409
    part = two.put(f"{TRICEPS}/profile", json={"current_ma": 5.0})
    assert part.status_code == 422, "nothing of the other channel's is taken over"
    assert two.put(f"{TRICEPS}/profile", json={**OWN, "current_ma": 5.0}).status_code == 200, "set anew"
    found = two.get(PERSON).json()
    assert (found["profile"]["current_ma"], found["muscle"]) == (5.0, None), "the site was the other channel's, too"
    assert set(found["channels"]) == {"biceps"}, "what triceps had before is older, and comes back no more"
    assert two.post("/v1/preview", json={"participant": "P017", "kind": "muscles"}).status_code == 200
    service.rig.channels = ["biceps"]
    service.rig.become("ready")
    soon(lambda: len(two.get("/v1/rig").json()["stimulator"].get("channels") or []) < 2)
    refused = two.post("/v1/tests", json={"participant": "P017"})
    assert refused.status_code == 409 and refused.json()["type"].endswith("other-order"), "of a rig of one, too"


def test_what_a_request_narrows_is_narrowed_on_each_channel(two: httpx.Client, service: Service) -> None:
    ready(two)
    weak = {"current_ma": 15.0, "max_pulse_width_us": 100.0, "max_torque_nm": 3.0}
    test = two.post("/v1/tests", json={"participant": "P017", "kind": "muscles", "profile": weak}).json()
    wait_done(two, test["id"])
    played: Any = service.rig.last_plan
    assert [one.profile.current_ma for one in played.channels] == [15.0, 12.0]
    assert (played.max_pulse_width_us, played.max_torque_nm) == (100.0, 3.0), "of all"


def test_a_calibration_keeps_to_the_tightest_torque_limit_of_its_channels(two: httpx.Client) -> None:
    two.put(f"{TRICEPS}/profile", json={**OWN, "max_torque_nm": 8.0})
    begun = two.post(f"{PERSON}/calibration", json={"channels": [{"name": "triceps"}]}).json()
    assert begun["max_torque_nm"] == 8.0, begun


@pytest.mark.parametrize("field", [{"segments": [{"name": "rest", "sequence": "rest"}]}, {"angle": {}}, {"joins": "m"}])
def test_its_plan_is_its_own(two: httpx.Client, field: dict[str, Any]) -> None:
    refused = two.post("/v1/tests", json={"participant": "P017", "kind": "muscles", **field})
    assert refused.status_code == 422 and next(iter(field)) in refused.json()["detail"]


def test_both_channels_are_calibrated_in_one_go(two: httpx.Client) -> None:
    at = f"{PERSON}/calibration"
    refused = two.post(at, json={"channels": [{"name": name} for name in TWO]})
    assert refused.status_code == 422 and "current of triceps" in refused.json()["detail"]
    asked = [{"name": "biceps"}, {"name": "triceps", "current_ma": 9.0}]
    begun = two.post(at, json={"channels": asked, "step_us": 5.0})
    assert begun.status_code == 201, begun.text
    assert [(one["name"], one["current_ma"]) for one in begun.json()["channels"]] == [
        ("biceps", 20.0),
        ("triceps", 9.0),
    ]
    for name, widths in (("biceps", 3), ("triceps", 2)):
        for threshold in ("sensory", "motor", "comfort"):
            for _ in range(widths):
                assert two.post(f"{at}/step", json={"channel": name}).status_code == 202
            assert two.post(f"{at}/mark", json={"channel": name, "threshold": threshold}).status_code == 200
    assert two.post(f"{at}/finish").status_code == 200
    found = two.get(PERSON).json()
    assert found["profile"]["max_pulse_width_us"] == 45.0 and found["profile"]["motor_pulse_width_us"] == 30.0
    own = found["channels"]["triceps"]["profile"]
    assert (own["current_ma"], own["max_pulse_width_us"], own["motor_pulse_width_us"]) == (9.0, 30.0, 20.0)
    marks = [entry["detail"] for entry in two.get("/v1/audit").json()["entries"] if entry["action"] == "mark motor"]
    assert [(one["channel"], one["pulse_width_us"]) for one in marks] == [("biceps", 30.0), ("triceps", 20.0)]
    other = {"side": "left", "muscle": "triceps brachii", "placement": "C"}
    assert two.put(f"{TRICEPS}/muscle", json=other).status_code == 200, "nobody had said one before"
    voids = two.put(f"{TRICEPS}/muscle", json={**other, "placement": "D"})
    assert voids.status_code == 409 and voids.json()["type"].endswith("voids-calibration")


def test_the_page_calibrates_both_side_by_side(two: httpx.Client, service: Service) -> None:
    ready(two)
    at = "/participants/P017/calibration"
    with signed_in(service) as tab:
        form = tab.get(at).text
        assert 'name="current_ma_triceps"' in form
        typed = {"csrf": csrf(tab), "seen": seen_of(form), "current_ma": "20", "step_us": "10"}
        assert tab.post(at, data={**typed, "current_ma_triceps": "9,5"}).status_code == 303
        for name in TWO:
            shown = tab.get(at).text
            version = shown.split('name="calibration" value="')[1].split('"')[0]
            sent = {"csrf": csrf(tab), "calibration": version, "channel": name, "shown_us": "10.0"}
            assert tab.post(f"{at}/step/up", data=sent).status_code == 303
        shown = tab.get(at).text
        assert 'class="ladders"' in shown and 'id="step-up-triceps"' in shown and "data-keys" not in shown
        assert shown.count('class="muscle n2" translate="no">triceps') >= 2
        told = two.get(f"{PERSON}/calibration").json()["channels"]
        assert [(one["current_ma"], one["pulse_width_us"]) for one in told] == [(20.0, 10.0), (9.5, 10.0)]


# ---- pages --------------------------------------------------------------------------------------------------------


def test_the_participants_page_has_a_form_for_each_channel(two: httpx.Client, service: Service) -> None:
    with signed_in(service) as tab:
        text = tab.get("/participants/P017").text
        assert 'class="muscle n1"' in text and 'id="channel-triceps"' in text and "nobody has set its limits" in text
        form = {"csrf": csrf(tab), "seen": seen_of(text), "current_ma": "9,5", "max_pulse_width_us": "220"}
        at = "/participants/P017/channels/triceps"
        part = tab.post(f"{at}/profile", data=form)
        assert part.status_code == 422, "all of the first limits, or none"
        saved = tab.post(f"{at}/profile", data={**form, "max_torque_nm": "15"})
        assert saved.status_code == 303 and two.get(PERSON).json()["channels"]["triceps"]["profile"] == {
            "current_ma": 9.5, "max_pulse_width_us": 220.0, "max_torque_nm": 15.0,
        }  # fmt: skip
        text = tab.get("/participants/P017").text
        jump = tab.post(f"{at}/profile", data={"csrf": csrf(tab), "seen": seen_of(text), "current_ma": "15"})
        assert "/confirm/" in jump.headers["location"], "a jump is asked about"
        wrong = tab.post(f"{at}/profile", data={"csrf": csrf(tab), "seen": seen_of(text), "current_ma": "15 mA"})
        assert wrong.status_code == 422 and 'id="current_ma-triceps-error"' in wrong.text
        placed = {"csrf": csrf(tab), "seen": seen_of(text), "side": "left", "muscle": "triceps brachii"}
        assert tab.post(f"{at}/muscle", data=placed).status_code == 303
        assert two.get(PERSON).json()["channels"]["triceps"]["muscle"] == "triceps brachii"


def seen_of(text: str) -> str:
    return text.split('name="seen" value="')[1].split('"')[0]


def test_the_question_names_each_muscle_in_its_colour(two: httpx.Client, service: Service) -> None:
    ready(two)
    with signed_in(service) as tab:
        text = tab.get("/participants/P017").text
        asked = tab.post("/participants/P017/tests", data={"csrf": csrf(tab), "seen": seen_of(text), "plan": "muscles"})
        assert asked.status_code == 303, asked.text
        question = tab.get(asked.headers["location"]).text
        assert '<span class="muscle n1" translate="no">biceps</span>' in question
        assert '<span class="muscle n2" translate="no">triceps</span>' in question
        assert "12 mA" in question and "all together" in question and "20.0 N·m" in question
        begun = tab.post(asked.headers["location"], data={"csrf": csrf(tab)})
        assert begun.status_code == 303 and begun.headers["location"].startswith("/tests/"), begun.text
        page = tab.get(begun.headers["location"]).text
        assert 'class="muscle n2"' in page


service = own_service()

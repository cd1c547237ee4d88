"""The rig's socket: refusals with their reasons, several clients, live events."""

from __future__ import annotations

import time

import pytest

from tests.harness.processes import Bench, RigClient, default_plan, short_plan

pytestmark = pytest.mark.wire


def test_a_page_sees_torque_before_and_during_a_test(shared: tuple[Bench, RigClient]):
    _bench, client = shared
    client.ask("subscribe")
    while client.events.get(timeout=5)["event"] != "state":
        pass
    live = client.events.get(timeout=5)
    assert live["event"] == "live"
    assert live["test_id"] is None
    assert len(live["time_s"]) == len(live["torque_min_nm"]) == len(live["torque_max_nm"]) > 0
    assert client.start(short_plan("live"))["ok"]
    events, end = [], time.monotonic() + 30
    while not events or events[-1]["event"] != "finished":
        events.append(client.events.get(timeout=end - time.monotonic()))
    states = [e["status"]["state"] for e in events if e["event"] == "state"]
    assert states[:4] == ["arming", "running", "sealing", "ready"]
    running = [e for e in events if e["event"] == "live" and e["test_id"] == "live" and e["elapsed_s"] > 0]
    widths = [w for e in running for w in e["pulse_width_us"]]
    assert len(widths) > 100
    assert max(widths) == 300.0
    assert {"rest", "prbs", "ramp"} <= {e["segment"] for e in running}
    assert all(lo <= hi for e in running for lo, hi in zip(e["torque_min_nm"], e["torque_max_nm"], strict=True))
    assert max(hi for e in running for hi in e["torque_max_nm"]) > 1.0
    assert client.status()["finished"]["test_id"] == "live"


def test_refusals_name_the_reason(shared: tuple[Bench, RigClient]):
    _bench, client = shared
    wide = default_plan("w")
    wide["profile"]["max_pulse_width_us"] = 250.0
    wide["segments"] = [{"name": "ramp", "sequence": "ramp", "settings": {"max_pulse_width_us": 300}}]
    refused = client.ask("start", plan=wide)
    assert refused["problem"]["code"] == "refused"
    assert "segment ramp, pulse 167" in refused["problem"]["detail"]
    assert "participant's profile" in refused["problem"]["detail"]
    wrong = default_plan("w", segments=[{"name": "x", "sequence": "prsb"}])
    assert client.ask("start", plan=wrong)["problem"]["code"] == "bad-plan"
    assert client.ask("start", plan=default_plan("../etc"))["problem"]["code"] == "bad-plan"
    assert client.ask("start", plan=default_plan("f", pulse_rate_hz=400.0))["problem"]["code"] == "refused"
    assert client.status()["state"] == "ready"


def test_what_comes_to_no_pulse_is_a_mistake_and_not_an_internal_one(shared: tuple[Bench, RigClient]):
    _bench, client = shared
    none = [{"name": "x", "sequence": "steps", "settings": {"on_s": 0.001, "off_s": 0.0}}]
    for kind in ("preview", "start"):
        problem = client.ask(kind, plan=default_plan("none", segments=none))["problem"]
        assert problem["code"] == "bad-plan"
        assert "segment 1 (x): too short for one pulse" in problem["detail"]
    train = {"calibration_id": "none", "participant": "P01", "by": "t", "train_s": 0.1, "pulse_rate_hz": 1.0}
    assert "has no pulse" in client.ask("calibrate-start", **train)["problem"]["detail"]
    for wrong in (True, "20"):
        assert client.ask("calibrate-start", **{**train, "current_ma": wrong})["problem"]["code"] == "bad-plan"
    assert client.status()["state"] == "ready"


def test_malformed_requests_are_answered_not_fatal(shared: tuple[Bench, RigClient]):
    bench, client = shared
    for line in ("not json", '{"kind": "dance"}', '{"kind": "start", "plan": {"test_id": 5}}', "[]"):
        raw = bench.client()
        raw._replies[0] = client.events.__class__()
        raw.send_raw(line)
        reply = raw._replies[0].get(timeout=5)
        assert not reply["ok"]
        assert reply["problem"]["detail"]
    assert client.status()["state"] == "ready"


def test_sequences_and_the_default_test_are_told(shared: tuple[Bench, RigClient]):
    _bench, client = shared
    body = client.ask("sequences")["body"]
    told = {sequence["id"]: sequence["settings"]["properties"] for sequence in body["sequences"]}
    assert (
        told["prbs"]["bits"]["maximum"] == 12 and "comfort maximum" in told["ramp"]["max_pulse_width_us"]["description"]
    )
    same = [client.ask("preview", plan=default_plan("p", segments=given))["body"] for given in (None, body["default"])]
    assert same[0] == same[1] and same[0]["duration_s"] > 30


def test_preview_gives_duration_and_dose(shared: tuple[Bench, RigClient]):
    _bench, client = shared
    table = {"pulse_width_us": [0.0, 100.0, 300.0], "torque_nm": [0.0, 0.0, 8.0]}
    body = client.ask("preview", plan=default_plan("p"), recruitment=table)["body"]
    assert body["duration_s"] == pytest.approx(38.7)
    assert 3000 < body["charge_uc"] < 4000
    assert body["torque_time_nms"] > 50
    assert [s["name"] for s in body["segments"]][1] == "prbs"
    assert len(body["pulse_width_us"]) == 1548

"""Tests that are extended over the socket: one that is watched, one whose client dies, one whose rig dies."""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from identify.records.read import read
from tests.harness.processes import Bench, RigClient, default_plan, kill_hard

pytestmark = pytest.mark.wire

KEY = "a key that nobody knows"
FIXED = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}},
    {"name": "ramp", "sequence": "ramp", "settings": {"up_s": 1.0, "down_s": 1.0}},
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}},
]
ADDED = [{"name": "added", "sequence": "steps", "settings": {"on_s": 0.6, "off_s": 0.4, "repeats": 1}}]


def adaptive_plan(test_id: str, **fields: Any) -> dict[str, Any]:
    bounds = {"max_duration_s": 30.0, "max_torque_time_nms": 1000.0}
    return default_plan(test_id, **{"segments": FIXED, "adaptive": bounds, **fields})


def start(client: RigClient, test_id: str) -> None:
    """Ask for it once the rest between two tests is over."""
    end = time.monotonic() + 30
    while not (reply := client.ask("start", plan=adaptive_plan(test_id), key=KEY))["ok"]:
        assert "rest_between_tests_s" in reply["problem"]["detail"] and time.monotonic() < end, reply
        time.sleep(0.05)


def events_of(client: RigClient, test_id: str) -> list[dict[str, Any]]:
    """Live events of that test up to its finished event, which is the last."""
    found: list[dict[str, Any]] = []
    while not found or found[-1]["event"] != "finished":
        event = client.events.get(timeout=60)
        if event["event"] != "state" and event["test_id"] == test_id:
            found.append(event)
    return found


def test_a_watched_test_is_extended_to_its_end(shared: tuple[Bench, RigClient]):
    bench, client = shared
    watcher = bench.client()
    watcher.ask("subscribe", samples=True)
    client.ask("subscribe")
    start(client, "watched")
    after = 40
    for _ in range(3):
        reply = client.ask("extend", test_id="watched", key=KEY, after=after, segments=ADDED)
        assert reply["ok"], reply
        after = reply["body"]["laid"]
    assert client.ask("extend", test_id="watched", key=KEY, after=40, segments=ADDED)["problem"]["code"] == "late"
    assert watcher.ask("extend", test_id="watched", key="guess", after=after, segments=ADDED)["problem"]["code"] == (
        "bad-plan"
    )
    seen, plain = events_of(watcher, "watched"), events_of(client, "watched")
    assert all(event["samples"] is None for event in plain[:-1])
    samples = [event["samples"] for event in seen[:-1]]
    counter = np.concatenate([batch["counter"] for batch in samples])
    assert np.all(np.diff(counter) == 1)
    assert len(counter) > 1500
    watcher.close()
    finished = seen[-1]
    assert (finished["outcome"], finished["summary"]["ended_by"]) == ("completed", "plan"), finished["reason"]
    laid = seen[-2]["laid_segments"]
    assert [s["name"] for s in laid] == ["rest", "added", "added", "added", "ramp", "rest"]
    with h5py.File(finished["recording_path"]) as file:
        assert list(file["segments/name"].asstr()[:]) == [s["name"] for s in laid]
        assert list(file["segments/start_s"][:]) == [s["start_s"] for s in laid]
    assert read(Path(finished["recording_path"])).segment_names == ("rest", "added", "ramp", "rest")
    torque_nm = np.concatenate([batch["torque_nm"] for batch in samples])
    assert finished["summary"]["torque_peak_nm"] == pytest.approx(np.max(np.abs(torque_nm)), abs=1e-4)


def test_a_test_whose_client_dies_plays_its_fixed_plan(shared: tuple[Bench, RigClient]):
    bench, client = shared
    client.ask("subscribe")
    starter = bench.client()
    start(starter, "left")
    assert starter.ask("extend", test_id="left", key=KEY, after=40, segments=ADDED)["ok"]
    starter._replies[9] = queue.Queue()
    starter.send_raw('{"kind": "extend", "id": 9, "test_id": "left", "key": "')  # it dies in the middle of a word
    starter.close()
    finished = events_of(client, "left")[-1]
    assert (finished["outcome"], finished["summary"]["ended_by"]) == ("completed", "plan"), finished["reason"]
    record = read(Path(finished["recording_path"]))
    assert record.segment_names == ("rest", "added", "ramp", "rest")


def test_a_stop_in_the_middle_of_many_extensions(shared: tuple[Bench, RigClient]):
    bench, client = shared
    client.ask("subscribe")
    start(client, "flood")
    wide = [{"name": "x", "sequence": "widths", "settings": {"pulse_width_us": [301.0] * 1000}}]
    flood = json.dumps({"kind": "extend", "id": 0, "test_id": "flood", "key": KEY, "after": 40, "segments": wide * 8})
    raw = bench.client()
    raw._replies[0] = queue.Queue()
    for _ in range(60):
        raw.send_raw(flood)
    evidence = client.ask("stop", reason="enough", by="P")["body"]
    assert evidence["confirmed"], evidence
    codes = {raw._replies[0].get(timeout=20)["problem"]["code"] for _ in range(60)}
    assert codes <= {"refused", "busy", "late"}
    finished = events_of(client, "flood")[-1]
    assert (finished["outcome"], finished["summary"]["ended_by"]) == ("stopped", "stopped")
    client.wait_state("latched")
    late = client.ask("extend", test_id="flood", key=KEY, after=40, segments=ADDED)
    assert late["problem"]["code"] == "late"
    assert client.ask("rearm", by="nurse")["ok"]


@pytest.mark.slow
def test_a_rig_that_dies_leaves_the_true_sequence(make_bench: Callable[..., Bench]):
    bench = make_bench("--noise-seed", "7")
    client = bench.start_rig()
    start(client, "dies")
    assert client.ask("extend", test_id="dies", key=KEY, after=40, segments=ADDED * 8)["ok"]
    while client.status()["elapsed_s"] < 2.5:
        time.sleep(0.02)
    assert bench.rig is not None
    kill_hard(bench.rig)
    again = bench.start_rig()
    status = again.wait_state("uncertain")
    late = again.ask("extend", test_id="dies", key=KEY, after=360, segments=ADDED)
    assert late["problem"]["code"] == "late"
    assert status["finished"]["outcome"] == "fault"
    record = read(Path(status["finished"]["recording_path"]))
    assert record.segment_names[:2] == ("rest", "added")
    assert set(record.segment_names) == {"rest", "added"}

"""Tests that are extended over the socket: one that is watched, one whose client dies, one whose rig dies."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.identify.records import read
from tests.harness.processes import Bench, RigClient, default_plan

pytestmark = [pytest.mark.wire, pytest.mark.campaign]  # an extension must not be late; tests/rig/test_extending.py

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
    finished = seen[-1]
    assert (finished["outcome"], finished["summary"]["ended_by"]) == ("completed", "plan"), finished["reason"]
    assert all(event["samples"] is None for event in plain[:-1])
    samples = [event["samples"] for event in seen[:-1]]
    counter = np.concatenate([batch["counter"] for batch in samples])
    assert np.all(np.diff(counter) == 1)
    assert len(counter) > 1500
    watcher.close()
    laid = seen[-2]["laid_segments"]
    assert [s["name"] for s in laid] == ["rest", "added", "added", "added", "ramp", "rest"]
    with h5py.File(finished["recording_path"]) as file:
        assert list(file["segments/name"].asstr()[:]) == [s["name"] for s in laid]
        assert list(file["segments/start_s"][:]) == [s["start_s"] for s in laid]
    assert read(Path(finished["recording_path"])).segment_names == ("rest", "added", "ramp", "rest")
    torque_nm = np.concatenate([batch["torque_nm"] for batch in samples])
    assert finished["summary"]["torque_peak_nm"] == pytest.approx(np.max(np.abs(torque_nm)), abs=1e-4)

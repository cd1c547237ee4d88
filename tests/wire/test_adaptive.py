"""Tests that stop themselves, through the service with its real adviser, on the emulated rig at the world's speed."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import httpx
import numpy as np
import pytest

from stimrig.api.settings import Settings
from stimrig.api.web.app import create_app
from tests.api.conftest import TOKEN, Server, wait_done
from tests.harness.looks_first import LooksFirst
from tests.harness.processes import Bench

pytestmark = [pytest.mark.wire, pytest.mark.timeout(600)]
PATIENCE_S = 300.0


@dataclass
class Whole:
    """Rig and service."""

    client: httpx.Client
    adviser: Any

    def start(self, **more: Any) -> str:
        """Ask until the rest between two tests is over; the test's id. What it can reach is computed before."""
        end = time.monotonic() + PATIENCE_S
        body = {"participant": "P017", "kind": "adaptive", **more}
        answer = self.client.post("/v1/preview", json=body)
        assert answer.status_code == 200, answer.text
        while True:
            answer = self.client.post("/v1/tests", json=body)
            if answer.status_code == 202 or "rest_between_tests_s" not in answer.text:
                assert answer.status_code == 202, answer.text
                return answer.json()["id"]
            assert time.monotonic() < end, answer.text
            time.sleep(0.2)

    def until(self, test_id: str, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The test once that holds."""
        end = time.monotonic() + PATIENCE_S
        while not holds(document := self.client.get(f"/v1/tests/{test_id}").json()):
            assert time.monotonic() < end and not document["done"], document
            time.sleep(0.05)
        return document


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Whole]:
    bench = Bench(tmp_path_factory.mktemp("adaptive"), "--noise-seed", "13")
    try:
        bench.start_rig().wait_state("ready")
        folder = tmp_path_factory.mktemp("service")
        app = create_app(Settings(data_dir=folder, admin_token=TOKEN, rig_socket=bench.socket, port=0))  # pyright: ignore[reportArgumentType]
        with Server(app) as url, httpx.Client(base_url=url, auth=LooksFirst(TOKEN), timeout=PATIENCE_S) as client:
            client.post("/v1/participants", json={"code": "P017"})
            yield Whole(client, app.state.context.runner.adaptive.adviser)
    finally:
        bench.close()


def test_a_test_stops_itself_and_is_identified(whole: Whole) -> None:
    test_id = whole.start(target={"curve_percent": 4.0, "step_percent": 4.0})
    document = wait_done(whole.client, test_id, PATIENCE_S)
    told, summary = document["adaptive"], document["summary"]
    print(json.dumps([{k: v for k, v in row.items() if k != "words"} for row in told["decisions"]]))
    print(told["ended"], told["problem"], told["torque_time_nm_s"], summary)
    assert document["state"] == "completed", document["reason"]
    assert told["decisions"], told
    if told["ended"] == "known-enough":
        assert told["problem"] == ""
        assert told["knowledge"]["curve_percent"] <= 4.0
        assert summary["duration_s"] < 38.7
    else:  # the machine was too busy: answers came late, or pulses; then the fixed plan played, and it never waited
        assert told["ended"] in ("fixed-rest", "time")
        kinds = {row["kind"] for row in told["decisions"] if not (row.get("late") or row.get("refused"))}
        assert kinds <= {"next", "misfit"}
        assert told["problem"] == "" or ("misfit" in kinds and (summary["dropped_pulses"] > 0 or summary["warnings"]))
    assert document["fit"]["fit_percent"] > 90.0


@pytest.mark.campaign
def test_a_worker_that_is_killed_ends_in_the_fixed_plan(whole: Whole, tmp_path: Path) -> None:
    test_id = whole.start(target={"curve_percent": 0.2, "step_percent": 0.2}, anyway=True)
    whole.until(test_id, lambda document: bool(document["adaptive"]["decisions"]))
    process = whole.adviser.worker.process
    process.kill()
    told = whole.until(test_id, lambda document: document["adaptive"]["state"] == "fixed")["adaptive"]
    assert "The worker process died" in told["problem"]
    after_s = whole.client.get(f"/v1/tests/{test_id}").json()["elapsed_s"]
    whole.until(test_id, lambda document: document["elapsed_s"] > after_s + 3.0)
    assert whole.client.post(f"/v1/tests/{test_id}/enough").status_code == 200
    document = wait_done(whole.client, test_id, PATIENCE_S)
    assert (document["state"], document["adaptive"]["ended"]) == ("completed", "enough")
    path = tmp_path / "recording.h5"
    path.write_bytes(whole.client.get(document["recording_url"]).content)
    with h5py.File(path) as file:
        names = list(file["segments/name"].asstr()[:])
        assert names[0] == "opening" and {"prbs", "rest"} & set(names[1:])
        assert file["segments/end_s"][-1] > after_s + 3.0
        assert np.any(file["pulses/sent_pulse_width_us"][round(40 * after_s) :] > 0)  # it did not wait, resting

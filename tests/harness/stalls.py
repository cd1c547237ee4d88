"""A line that stalls: what is felt at the electrode, by the emulator's own record, on both stimulators.

The line between rig and emulator holds what it is given, towards the device, the host, or both, in each phase of a
test, and then delivers all of it at once. In half of the cases a stop is requested in the middle of it. Judged by what
the emulated electrodes felt: no interval below the limit, at most one pulse after the request to stop, none after a
confirmed answer, and none after an unconfirmed answer that did not say that one may come.
"""

from __future__ import annotations

import json
import random
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.harness.processes import CLINIC_WATCH, Bench, RigClient, default_plan

INTERVAL_S = 0.008
"""Shortest interval at the electrode: written down here again on purpose."""
SAME_CLOCK_S = 2e-4
"""Two processes read the same clock; between the device's doing and its answer is at least this."""
SEGMENTS = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.3}},
    {"name": "hold", "sequence": "steps", "settings": {"on_s": 1.0, "off_s": 0.0, "repeats": 1}},
    {"name": "ramp", "sequence": "ramp", "settings": {"up_s": 0.5, "down_s": 0.5}},
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.3}},
]
BEGINS_S = {"hold": 0.1, "three in a row": 0.0, "ramp": 1.2, "end": 1.85}
"""Seconds after the first pulse was felt; while arming, the line stalls before the start is asked for."""
FIRST_PULSE_S = 10.0


@dataclass
class Case:
    """One stalled test, and what came of it."""

    stimulator: str
    duration_s: float
    direction: str
    phase: str
    stop: bool
    outcome: str = ""
    reason: str = ""
    felt: int = 0
    shortest_s: float = float("inf")
    after_request: int = 0
    after_confirmed: int = 0
    confirmed: bool | None = None
    detail: str = ""
    warned: bool = False
    dropped: int = 0
    held: int = 0
    """Of the dropped ones those that waited for an acknowledgement; a busy machine drops late ones, too."""
    wrong: list[str] = field(default_factory=list)


class Rig:
    """An emulated rig whose line stalls."""

    def __init__(self, folder: Path, stimulator: str) -> None:
        self.bench = Bench(folder, "--stimulator", stimulator, "--noise-seed", "3")
        self.client: RigClient = self.bench.start_rig(watch=CLINIC_WATCH)
        self.client.ask("subscribe")
        self.other = self.bench.client()
        self._number = 0

    def close(self) -> None:
        """End both processes."""
        self.bench.close()

    def play(self, case: Case, rng: random.Random) -> Case:
        """Play one test, stall its line, and judge."""
        self._number += 1
        test_id = f"stall{self._number}"
        before = self.bench.fault(cmd="state")["pulses_received"]
        asked: list[tuple[float, float, dict[str, Any]]] = []
        if case.phase == "arming":
            self._stall(case)
            stopping = self._stop_soon(case, rng, asked)
        reply = self.client.start(default_plan(test_id, segments=SEGMENTS))
        if reply["ok"]:
            if case.phase != "arming":
                self._wait_first_pulse(before)
                time.sleep(BEGINS_S[case.phase] + rng.uniform(0.0, 0.025))
                for _ in range(3 if case.phase == "three in a row" else 1):
                    self._stall(case)
                    if case.phase == "three in a row":
                        time.sleep(case.duration_s + 0.1)
                stopping = self._stop_soon(case, rng, asked)
            event = self.client.wait_finished(test_id, timeout_s=30)
            case.outcome, case.reason = event["outcome"], event["reason"]
            case.dropped = event["summary"].get("dropped_pulses", 0)
            case.held = _held(event["recording_path"])
            case.warned = any("acknowledge" in text for text in event["summary"].get("warnings", []))
        else:
            case.outcome, case.reason = "refused", reply["problem"]["detail"]
        stopping.join()
        time.sleep(0.1 + (case.duration_s if case.outcome != "completed" else 0.0))  # what lay in the line comes out
        felt = self.bench.fault(cmd="pulses", since=before)["pulses"]
        _judge(case, [pulse["monotonic_s"] for pulse in felt if pulse["delivered"]], asked)
        self._repair()
        return case

    def _wait_first_pulse(self, before: int) -> None:
        """How long arming takes depends on the machine."""
        end_s = time.monotonic() + FIRST_PULSE_S
        while self.bench.fault(cmd="state")["pulses_received"] <= before and time.monotonic() < end_s:
            if self.client.status()["state"] not in ("arming", "running"):
                return
            time.sleep(0.005)

    def _stall(self, case: Case) -> None:
        ways = {way: case.direction in (way, "both") for way in ("to_device", "to_host")}
        answer = self.bench.fault(cmd="fault", name="line_stalled", on=True, for_s=case.duration_s, **ways)
        assert answer["ok"], answer

    def _stop_soon(
        self, case: Case, rng: random.Random, asked: list[tuple[float, float, dict[str, Any]]]
    ) -> threading.Thread:
        def stop() -> None:
            if case.stop:
                time.sleep(rng.uniform(0.0, case.duration_s))
                asked_s = time.monotonic()
                body = self.other.ask("stop", reason="bench", by="bench")["body"]
                asked.append((asked_s, time.monotonic(), body))

        thread = threading.Thread(target=stop)
        thread.start()
        return thread

    def _repair(self) -> None:
        status = self.client.wait_state("ready", "latched", "disconnected", "uncertain")
        end_s = time.monotonic() + 5
        while status["state"] != "ready" and time.monotonic() < end_s:
            self.client.ask("rearm", by="bench")
            status = self.client.status()
        assert status["state"] == "ready", status


def _judge(case: Case, felt_s: list[float], asked: list[tuple[float, float, dict[str, Any]]]) -> None:
    case.felt = len(felt_s)
    if len(felt_s) > 1:
        case.shortest_s = float(np.min(np.diff(felt_s)))
        if case.shortest_s < INTERVAL_S:
            case.wrong.append(f"two pulses felt {1e3 * case.shortest_s:.2f} ms apart")
    for asked_s, answered_s, body in asked:
        case.confirmed, case.detail = body["confirmed"], body["detail"]
        case.after_request = sum(time_s > asked_s for time_s in felt_s)
        # before its answer the rig has watched the torque: a pulse later than that was not confirmed away
        after_answer = sum(time_s > answered_s + SAME_CLOCK_S for time_s in felt_s)
        case.after_confirmed = after_answer if body["confirmed"] else 0
        if case.after_request > 1:
            case.wrong.append(f"{case.after_request} pulses felt after the request to stop")
        if case.after_confirmed:
            case.wrong.append("a pulse felt after a confirmed stop")
        if after_answer and not body["confirmed"] and not body.get("pulse_may_follow"):
            case.wrong.append("a pulse felt after an answer that did not say that it may come")
    if case.outcome == "completed" and case.held and not case.warned:
        case.wrong.append("pulses dropped for a late acknowledgement and not told")
    if case.outcome not in ("completed", "refused") and not case.reason:
        case.wrong.append("it ended without a reason")


def _held(recording_path: str) -> int:
    with h5py.File(recording_path) as file:
        events = json.loads(file.attrs["events"])
    return sum(e.get("event") == "dropped" and "not acknowledged" in e.get("reason", "") for e in events)


def stalls(wanted: list[Case], seed: int, told: Any = lambda _: None) -> list[Case]:
    """Play the cases of one stimulator, one after another."""
    rng, found = random.Random(seed), []
    with tempfile.TemporaryDirectory(prefix="rig-stalls-") as folder:
        rig = Rig(Path(folder), wanted[0].stimulator)
        try:
            for case in wanted:
                found.append(rig.play(case, rng))
                told(case)
        finally:
            rig.close()
    return found

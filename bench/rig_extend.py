"""How soon a test is extended and how old a watcher's samples are; the reply to a status is the reference.

    python -m bench.rig_extend [--seconds S] [--busy N]

Extends one test second by second, in real time, on the emulated rig. Half a second before each boundary it asks for the
status, then adds a PRBS of one second.
"""

from __future__ import annotations

import contextlib
import queue
import time
from typing import Any

import numpy as np

from bench.common import emulated_rig, parser, spread
from tests.harness.processes import RigClient, default_plan

KEY = "0123456789abcdef"
SECOND = {"name": "prbs", "sequence": "prbs", "settings": {"bits": 5, "chips": 20, "clock_pulses": 2}}
FIXED = [{"name": "rest", "sequence": "rest", "settings": {"duration_s": 2.0}}]


def measure(seconds: float, busy: int) -> dict[str, Any]:
    """Replies to extensions and to statuses, ages of samples, and the finished test's lateness, ms."""
    with emulated_rig(busy=busy) as (bench, client):
        watcher = bench.client()
        watcher.ask("subscribe", samples=True)
        bounds = {"max_duration_s": seconds + 4.0, "max_torque_time_nms": 1e6}
        reply = client.ask("start", plan=default_plan("bench", segments=FIXED, adaptive=bounds), key=KEY)
        if not reply["ok"]:
            raise SystemExit(reply["problem"]["detail"])
        return _watch(watcher, client, seconds)


def _watch(watcher: RigClient, client: RigClient, seconds: float) -> dict[str, Any]:
    """Extend until the finished event."""
    events: list[tuple[float, dict[str, Any]]] = []
    took: dict[str, list[float]] = {"extend": [], "status": []}
    late = seen = 0
    while True:
        with contextlib.suppress(queue.Empty):
            event = watcher.events.get(timeout=60)
            if event["event"] == "finished":
                break
            if event["event"] != "live" or not event["laid"]:
                continue
            events.append((time.monotonic(), event))
            if event["laid"] < seen:
                continue  # from before the last answer
            if event["boundary_s"] < seconds and event["boundary_s"] - event["elapsed_s"] < 0.5:
                _timed(client, took["status"], "status")
                fields = {"test_id": "bench", "key": KEY, "after": event["laid"], "segments": [SECOND]}
                reply = _timed(client, took["extend"], "extend", **fields)
                late += not reply["ok"]
                seen = reply["body"].get("laid", seen)
    summary = event["summary"]
    return {
        "extensions": len(took["extend"]), "late": late, "outcome": event["outcome"], "reason": event["reason"],
        "extend_ms": spread(took["extend"]), "status_ms": spread(took["status"]),
        "extend_over_status": float(np.median(took["extend"]) / np.median(took["status"])),
        "sample_age_ms": spread(_ages(events)), "lateness_ms": summary["lateness_ms"],
        "dropped_pulses": summary["dropped_pulses"],
    }  # fmt: skip


def _timed(client: RigClient, took: list[float], kind: str, **fields: Any) -> dict[str, Any]:
    began_s = time.monotonic()
    reply = client.ask(kind, **fields)
    took.append(time.monotonic() - began_s)
    return reply


def _ages(events: list[tuple[float, dict[str, Any]]]) -> list[float]:
    """Seconds from a sample's arrival at the rig to the watcher; the promptest event is taken for one without delay."""
    zero_s = min(came_s - event["elapsed_s"] for came_s, event in events if event["elapsed_s"] > 0)
    return [
        came_s - zero_s - host_s
        for came_s, event in events
        for host_s in event["samples"]["host_time_s"]
        if event["elapsed_s"] > 1
    ]


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--seconds", type=float, default=40.0)
    made.add_argument("--busy", type=int, default=0, help="CPU-bound processes beside the rig")
    options = made.parse_args()
    found = measure(options.seconds, options.busy)
    print(f"{found['extensions']} extensions, {found['late']} late; {found['outcome']} {found['reason']}")
    for name in ("extend_ms", "status_ms", "sample_age_ms", "lateness_ms"):
        print(f"{name:14} " + ", ".join(f"{what} {value:.2f}" for what, value in found[name].items()))
    print(f"extend over status {found['extend_over_status']:.2f}; {found['dropped_pulses']} pulses dropped")


if __name__ == "__main__":
    main()

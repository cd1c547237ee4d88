"""A line that doubles a command, in real time: the test ends. Lines that stall are the simulator's."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.harness.processes import Bench, RigClient, default_plan

pytestmark = [pytest.mark.wire, pytest.mark.realtime, pytest.mark.slow]


def test_a_line_that_doubles_a_command_is_not_gone_on_with(make_bench: Callable[..., Bench]):
    """Two pulses of one cannot be prevented here: it is seen by its acks, and stays at that."""
    bench = make_bench("--noise-seed", "7", speed=1.0)
    client = bench.start_rig()
    client.ask("subscribe")
    event, felt = doubled(bench, client, "doubled")
    assert event["outcome"] == "fault"
    assert "was not sent" in event["reason"], event["reason"]
    assert any("may have been felt" in text for text in event["summary"]["warnings"])
    assert sum(b["time_s"] - a["time_s"] < 0.008 for a, b in itertools.pairwise(felt)) <= 1


def doubled(bench: Bench, client: RigClient, test_id: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Play a test whose commands are doubled after 20 pulses: its end, and the pulses that were felt."""
    segments = [{"name": "hold", "sequence": "steps", "settings": {"on_s": 60.0, "off_s": 0.0, "repeats": 1}}]
    before = bench.fault(cmd="state")["pulses_received"]
    started = client.start(default_plan(test_id, segments=segments))
    assert started["ok"], started
    end_s = time.monotonic() + 60
    while bench.fault(cmd="state")["pulses_received"] < before + 20 and client.status()["state"] == "running":
        assert time.monotonic() < end_s
        time.sleep(0.01)
    bench.fault(cmd="fault", name="frames_doubled", on=True)
    event = client.wait_finished(test_id)
    bench.fault(cmd="fault", name="frames_doubled", on=False)
    felt = bench.fault(cmd="pulses", since=before)["pulses"]
    client.wait_state("latched")
    rearmed = client.ask("rearm", by="nurse")
    assert rearmed["ok"], rearmed
    return event, felt

"""A line that stalls, in real time: the limits hold at the electrode. `python -m bench.rig_stalls` plays all cases."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.harness.processes import Bench, RigClient, default_plan
from tests.harness.stalls import Case, stalls

pytestmark = [pytest.mark.wire, pytest.mark.realtime, pytest.mark.slow]

CASES = (
    (0.09, "to_device", "three in a row", False),
    (0.04, "both", "hold", False),
    (0.2, "to_device", "hold", True),
    (0.4, "to_host", "ramp", True),
    (0.12, "both", "arming", False),
    (2.0, "to_device", "hold", True),
)


@pytest.mark.parametrize("stimulator", ["p24", "rehastim2"])
def test_a_stalled_line_lets_go_one_pulse_at_most(stimulator: str):
    found = stalls([Case(stimulator, *case) for case in CASES], seed=11)
    assert [case.wrong for case in found] == [[]] * len(CASES), found
    played = [case for case in found if case.phase != "arming" and "stale" not in case.reason]  # 0.1 s: a busy machine
    assert len(played) >= 3 and all(case.felt > 0 for case in played), found
    assert any(case.dropped for case in found), found  # else nothing was stalled


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

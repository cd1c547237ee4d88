"""A short fault campaign; the whole one is `python -m bench.faults`, its table docs/results/faults.md."""

from __future__ import annotations

import pytest

from tests.harness.campaign.cases import CASES, PHASES
from tests.harness.campaign.runner import campaign, order
from tests.harness.campaign.table import table

pytestmark = [pytest.mark.wire, pytest.mark.slow]

FAULTS = (
    "disk_full",
    "host_stopped_2s",
    "host_killed",
    "cell_silent",
    "corrupt_commands",
    "line_stalled",
    "line_stalled_70_ms",
    "angle_silent",
    "angle_offset_step",
    "angle_stuck",
    "angle_frames_lost",
)
"""Those that the other tests of this folder do not make, and one of the load cell, played amid pulses (PRBS).

That one holds the 0.1 s of a rig file: a campaign's rigs have its watch.
"""


def test_a_short_campaign_finds_nothing_wrong():
    jobs = [(fault, PHASES[1:4][number % 3], 77) for number, fault in enumerate(FAULTS)]
    found = campaign(jobs, workers=1, speed=4.0, minutes=3.5)
    assert len(found) == len(FAULTS)
    for verdict in found:
        assert not verdict.failed, verdict
        assert verdict.wrong == [], verdict
        assert verdict.opens, verdict
        assert verdict.felt <= verdict.kept
    text = table(found, "A test.")
    assert all(f"| {fault} |" in text for fault in FAULTS)
    assert f"injections with anything wrong: 0 of {len(FAULTS)}" in text


def test_the_whole_campaign_is_every_fault_in_every_phase():
    jobs = order(len(CASES) * len(PHASES), seed=1)
    assert {(fault, phase) for fault, phase, _ in jobs} == {(fault, phase) for fault in CASES for phase in PHASES}
    assert len({seed for _, _, seed in order(512, seed=1)}) >= 3

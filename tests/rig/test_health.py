"""The device's watchdog is fed upon proof of health and by nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.acquire import health
from rig.journal import Kind
from rig.messages import SegmentPlan
from tests.rig.fakes import ON_A_BUSY_DISK, VirtualRig

WORDS = {
    "torque": "stale",
    "ack": "acknowledged",
    "disk slow": "too slow",
    "disk full": "MB free",
    "sender": "blocked",
}
REST = [SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 3.0})]


def test_through_a_rest_the_device_is_fed_at_every_pulses_time(tmp_path: Path):
    rig = VirtualRig(tmp_path, REST)
    assert rig.execute().outcome == "completed"
    assert rig.stimulator.sent == []
    assert len(rig.stimulator.fed_s) == 120
    rig.gate.feed()  # after the test nothing feeds any more
    assert len(rig.stimulator.fed_s) == 120


@pytest.mark.parametrize("fault", WORDS)
def test_without_a_proof_nothing_is_fed(tmp_path: Path, fault: str):
    hold = [SegmentPlan(name="hold", sequence="steps", settings={"on_s": 4.0, "off_s": 0.0, "repeats": 1})]
    rig = VirtualRig(tmp_path, hold)
    at: list[float] = []
    disk = health.Disk.__dict__["age_s"], health.MIN_FREE_BYTES

    def inject() -> None:
        at.append(rig.clock.now_s())
        if fault == "torque":
            rig.cell.silent = True
        elif fault == "ack":
            rig.stimulator.ack_delay_s = None
        elif fault == "disk slow":
            health.Disk.age_s = lambda _: ON_A_BUSY_DISK.stale_disk_s + 0.1  # pyright: ignore[reportAttributeAccessIssue]
        elif fault == "disk full":
            health.MIN_FREE_BYTES = 2**62
        else:
            rig.clock.advance(0.5)

    rig.at(1.0, inject)
    try:
        result = rig.execute()
    finally:
        health.Disk.age_s, health.MIN_FREE_BYTES = disk  # pyright: ignore[reportAttributeAccessIssue]
    assert result.outcome == "fault"
    assert WORDS[fault] in result.reason
    bound_s = 0.13 if fault in ("torque", "ack") else 0.03
    assert rig.stimulator.fed_s[-1] - rig.stimulator.fed_s[0] > 0.9, "before the fault it was fed"
    assert max(rig.stimulator.fed_s) - at[0] < bound_s
    assert max(sent_s for sent_s, _ in rig.stimulator.sent) - at[0] < bound_s


def test_a_pulse_whose_time_passes_while_its_intent_is_written_is_not_sent(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    append = rig.journal.append

    def slow(kind: object, payload: bytes) -> None:
        append(kind, payload)  # pyright: ignore[reportArgumentType]
        if kind == Kind.INTENT:
            rig.clock.advance(0.011)

    rig.journal.append = slow  # pyright: ignore[reportAttributeAccessIssue]
    result = rig.execute()
    assert rig.stimulator.sent == []
    assert result.dropped > 50
    assert rig.gate.charge_uc == 0

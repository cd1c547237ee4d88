"""The device's watchdog is fed upon proof of health and by nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.acquire.health import DEFAULT_WATCH, SYNC_PERIOD_S
from rig.adapters.files import Files
from tests.rig.fakes import VirtualRig, hold, rest, slow_work

FAULTS = {
    "disk slow": ("too slow", DEFAULT_WATCH.stale_disk_s + 0.03),
    "disk full": ("MB free", SYNC_PERIOD_S + 0.03),
    "disk gone": ("too slow", DEFAULT_WATCH.stale_disk_s + 0.03),
    "sender": ("blocked", 0.03),
}
"""What is told, and within how many seconds nothing is fed or sent any more; other faults: test_run.py."""


def test_through_a_rest_the_device_is_fed_at_every_pulses_time(tmp_path: Path):
    rig = VirtualRig(tmp_path, [rest(3.0)])
    assert rig.execute().outcome == "completed"
    assert rig.stimulator.sent == []
    assert len(rig.stimulator.fed_s) == 120
    rig.gate.feed()  # after the test nothing feeds any more
    assert len(rig.stimulator.fed_s) == 120


class Failing(Files):
    """A disk that is full or gone once it is told so."""

    fault = ""

    def free_bytes(self, folder: Path) -> int:
        if self.fault == "disk gone":
            raise OSError(5, "Input/output error")
        return 8 * 2**20 - 1 if self.fault == "disk full" else super().free_bytes(folder)


@pytest.mark.parametrize("fault", FAULTS)
def test_without_a_proof_nothing_is_fed(tmp_path: Path, fault: str):
    words, within_s = FAULTS[fault]
    rig = VirtualRig(tmp_path, [hold(on_s=6.0)])
    rig.machine.disk = disk = Failing()
    rig.cell.noise_nm = 0.01
    at: list[float] = []

    def inject() -> None:
        at.append(rig.clock.now_s())
        if fault == "disk slow":
            slow_work(rig.machine, 10.0)
        elif fault == "sender":
            rig.clock.advance(0.5)
        else:
            disk.fault = fault

    rig.at(1.0, inject)
    result = rig.execute()
    assert result.outcome == "fault"
    assert words in result.reason
    assert rig.stimulator.fed_s[-1] - rig.stimulator.fed_s[0] > 0.9, "before the fault it was fed"
    assert max(rig.stimulator.fed_s) - at[0] < within_s
    assert max(sent_s for sent_s, _ in rig.stimulator.sent) - at[0] < within_s

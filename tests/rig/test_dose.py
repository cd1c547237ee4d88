"""What is told of the dose of a test whose process died: never less than what was felt."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from stimrig.rig import journal
from stimrig.rig.journal import Kind
from tests.rig.live import ACK_S, SPEED, LiveRig
from tests.simulator.disk import SimulatedDisk
from tests.simulator.world import World

Make = Callable[..., LiveRig]
PULSES = 10


def died(
    make: Make, cut: Kind | None = None, acknowledged: bool = True, boot_id: str = "this-boot"
) -> tuple[list[float], dict[str, Any]]:
    """Charge of each pulse that was felt as a process died, µC, and what the next one tells; `cut`: its last block of
    that kind, and what came after it, was not written any more."""
    live = make(disk=SimulatedDisk(World(0)))
    disk: Any = live.machine.disk
    live.machine.boot_id = boot_id
    live.start(live.plan("one", hold_s=20.0))
    live.wait_pulses(PULSES)
    live.machine.wait(2 * ACK_S if acknowledged else 0.0)
    felt_uc = [pulse.charge_uc for _, pulse in live.stimulator.sent]
    file = disk.files[live.config.data_dir / "journals" / "one.journal"]
    if cut is not None:
        data = bytes(file.data)
        places = [i for i in range(len(data)) if (block := journal.block_at(data, i)) is not None and block[0] == cut]
        del file.data[places[-1] :]
    assert live.rig.player.run is not None
    live.rig.player.run.journal._failure = "dead"  # nothing of that process is written any more
    disk.process_ended()
    again = make(disk=disk, clock=live.clock)
    assert again.rig.status().state == "uncertain" and again.rig.finished is not None
    return felt_uc, again.rig.finished.summary


@pytest.mark.parametrize(
    ("cut", "acknowledged", "doubtful"), [(None, True, 0), (None, False, 1), (Kind.WRITTEN, False, 1)]
)
def test_what_the_journal_knows_is_told_and_a_pulse_that_is_in_doubt_counts(
    make: Make, cut: Kind | None, acknowledged: bool, doubtful: int
):
    felt_uc, summary = died(make, cut, acknowledged)
    assert summary["recovered"] is True
    assert summary["pulses"] == PULSES and summary["charge_uc"] == pytest.approx(sum(felt_uc))
    assert 0.5 + (PULSES - 1) / 40 <= summary["duration_s"] < 1.5
    assert summary["torque_time_nms"] > 0 and summary["torque_peak_nm"] > 0
    assert (summary["doubtful_pulses"], summary["dose_is_bound"]) == (doubtful, doubtful > 0)
    told = [words for words in summary["warnings"] if words.startswith("dose: of ")]
    assert len(told) == (doubtful > 0)


def test_after_a_power_failure_what_the_disk_may_have_lost_counts(make: Make):
    """The journal is synced twice a second, and a disk that takes none for 3 s ends the test."""
    felt_uc, summary = died(make, boot_id="the boot before")
    lost = summary["pulses"] - PULSES
    assert lost == pytest.approx(3.5 * SPEED * 40, abs=2)
    assert summary["charge_uc"] == pytest.approx(sum(felt_uc) + lost * felt_uc[-1])
    assert summary["dose_is_bound"] is True and summary["doubtful_pulses"] >= lost

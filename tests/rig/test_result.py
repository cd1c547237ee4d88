"""A calibration's result waits until it is stored, whatever becomes of the answer and of the process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from stimrig.rig.errors import BusyError, PlanError, RigError
from stimrig.rig.messages import CalibrateFinishRequest, CalibrateStartRequest, CalibrationResult, Threshold
from tests.rig.live import LiveRig
from tests.simulator.disk import SimulatedDisk
from tests.simulator.world import World

Make = Callable[..., LiveRig]
MARKS: tuple[Threshold, ...] = ("sensory", "motor", "comfort")


def open_one(live: LiveRig, calibration_id: str) -> None:
    request = CalibrateStartRequest(calibration_id=calibration_id, participant="P", by="nurse", train_s=0.2)
    live.ask(live.rig.calibrations.start(request))


def finish(live: LiveRig, calibration_id: str = "c1", discard: bool = False) -> CalibrationResult:
    request = CalibrateFinishRequest(by="nurse", calibration_id=calibration_id, discard=discard)
    return live.ask(live.rig.calibrations.finish(request))


def marked(make: Make) -> LiveRig:
    """A calibration that only has to be finished."""
    live = make(disk=SimulatedDisk(World(0)))
    open_one(live, "c1")
    for threshold in MARKS:
        live.step("up")
        live.wait("calibrating")
        live.machine.wait(4.0)
        live.mark(threshold)
    return live


def restarted(make: Make, live: LiveRig) -> LiveRig:
    """As after a kill: nothing is written any more."""
    live.machine.disk.process_ended()  # pyright: ignore[reportAttributeAccessIssue]
    return make(disk=live.machine.disk, clock=live.clock)


def test_the_result_waits_in_the_status_and_is_given_again_also_by_the_next_process(make: Make):
    live = marked(make)
    result = finish(live)
    assert result.profile is not None and len(result.recordings) == 3
    told = [event.status.calibrated for event in live.events if event.event == "state"][-1]
    for again in (live, restarted(make, live)):
        found = again.rig.status().calibrated
        assert found is not None and found == told
        assert (found.calibration_id, found.participant, found.by, found.result) == ("c1", "P", "nurse", result)
        assert finish(again) == result
        with pytest.raises(BusyError, match=r"result of calibration c1 of participant P waits .*, or discard it"):
            open_one(again, "c2")
        with pytest.raises(PlanError, match="none is open"):
            finish(again, "c2")
    assert again.stored("c2").calibrated is not None, "another one lets nothing go"
    assert again.stored("c1").calibrated is None
    assert again.stored("c1").calibrated is None
    open_one(again, "c2")
    assert restarted(make, again).rig.status().calibrated is None


def test_it_is_on_the_disk_before_it_is_told(make: Make):
    """Else a kill right after the answer loses what the answer's reader may not have stored yet."""
    live = marked(make)
    disk: Any = live.machine.disk
    disk.failing = True
    with pytest.raises(RigError, match=r"calibrated.json: .*; free some disk space"):
        finish(live)
    assert live.rig.status().state == "calibrating" and live.rig.status().calibrated is None
    disk.failing = False
    assert finish(live).profile is not None


def test_a_discard_keeps_nothing(make: Make):
    live = marked(make)
    assert finish(live, discard=True).profile is None
    assert live.rig.status().calibrated is None
    open_one(live, "c2")
    with pytest.raises(PlanError, match="'c1' is not open; c2 is"):
        finish(live, "c1")
    assert finish(live, "c2", discard=True).profile is None
    assert live.rig.status().state == "ready"


def test_a_result_that_waits_can_be_discarded_and_ends_with_its_day(make: Make):
    live = marked(make)
    assert finish(live).profile is not None
    live.clock.set_unix_ahead(25 * 3600.0)
    assert live.rig.status().calibrated is None
    with pytest.raises(PlanError, match="none is open"):
        finish(live)
    live.clock.set_unix_ahead(-25 * 3600.0)
    assert finish(live, discard=True).profile is None
    assert live.rig.status().calibrated is None
    open_one(live, "c2")


def test_a_stop_while_the_result_is_written_takes_it_back_from_nobody(make: Make):
    live = marked(make)
    request = CalibrateFinishRequest(by="nurse")
    task = live.begin(live.rig.calibrations.finish(request))
    live.machine.wait(0.001)
    live.stop("now")
    live.until(task.done.is_set)
    assert task.result.profile is not None
    status = live.rig.status()
    assert status.state == "latched" and status.calibrated is not None


def test_a_file_that_cannot_be_read_is_no_result(make: Make):
    live = make(disk=SimulatedDisk(World(0)))
    live.machine.disk.replace(live.config.data_dir / "calibrated.json", b'{"calibration_id": 1}')
    assert restarted(make, live).rig.status().calibrated is None

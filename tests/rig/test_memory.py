"""What is remembered across a death: latch, last pulse and a calibration's result; clocks that cannot be set back."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from stimrig.rig.adapters.files import Files
from stimrig.rig.clock import MonotonicClock, utc_text
from stimrig.rig.control.memory import LatchFile, Rest
from stimrig.rig.errors import BusyError, PlanError, RigError
from stimrig.rig.messages import CalibrationResult, Threshold
from stimrig.rig.requests import CalibrateFinishRequest, CalibrateStartRequest
from tests.rig.fakes import slow_work
from tests.rig.live import LiveRig
from tests.simulator.disk import SimulatedDisk
from tests.simulator.virtual_time import VirtualClock, VirtualMachine
from tests.simulator.world import World


def test_the_latch_is_remembered(tmp_path: Path):
    machine = VirtualMachine()
    latch = LatchFile(tmp_path, machine)
    assert machine.run(latch.read()) == (None, "")
    machine.run(latch.write("running", "test 7"))
    assert machine.run(LatchFile(tmp_path, machine).read()) == ("running", "test 7")
    machine.run(latch.write("latched", "electrode"))
    assert machine.run(LatchFile(tmp_path, machine).read()) == ("latched", "electrode")
    machine.run(latch.clear())
    machine.run(latch.clear())
    assert machine.run(latch.read()) == (None, "")


@pytest.mark.parametrize("content", ["", "{", "[]", '{"state": "running"}', "\udcff"])
def test_a_latch_that_cannot_be_read_counts_as_a_test_that_ran(tmp_path: Path, content: str):
    (tmp_path / "latch.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    machine = VirtualMachine()
    assert machine.run(LatchFile(tmp_path, machine).read())[0] == "running"


def test_what_is_asked_for_first_is_written_first_however_slow_the_disk_is(tmp_path: Path):
    machine = VirtualMachine()
    slow_work(machine, 0.5, 0.1, 0.3)
    latch = LatchFile(tmp_path, machine)
    asked = latch.write("running", "test 7"), latch.clear(), latch.write("latched", "electrode")
    tasks = [machine.tasks.begin(one, str(number)) for number, one in enumerate(asked)]
    machine.run(machine.tasks.join(tasks[-1]))
    assert machine.clock.now_s() == pytest.approx(1000.9)
    assert '"electrode"' in (tmp_path / "latch.json").read_text()


def test_one_rig_a_folder(tmp_path: Path):
    held = Files().lock(tmp_path)
    for _ in range(2):
        with pytest.raises(BusyError, match="another rig"):
            Files().lock(tmp_path)
        (tmp_path / "rig.lock").unlink(missing_ok=True)  # by hand: that lets no second rig in
    held.close()
    Files().lock(tmp_path).close()


def test_a_fast_clock_runs_faster():
    clock = MonotonicClock(100.0)
    asked_s, start_s, told_s = MonotonicClock().now_s(), clock.now_s(), MonotonicClock().now_s()
    assert 100.0 * asked_s <= start_s <= 100.0 * told_s
    for speed in (0.0, float("nan")):
        with pytest.raises(ValueError, match="clock speed"):
            MonotonicClock(speed)


def test_the_clock_goes_on_while_the_machine_is_suspended(monkeypatch: pytest.MonkeyPatch):
    before_s, gettime = MonotonicClock().now_s(), time.clock_gettime
    monkeypatch.setattr(time, "clock_gettime", lambda clock: gettime(clock) + 3600 * (clock == time.CLOCK_BOOTTIME))
    assert MonotonicClock().now_s() >= before_s + 3600


def test_utc_is_written_as_iso_8601():
    assert utc_text(1_700_000_000.1234) == "2023-11-14T22:13:20.123Z"


PULSE_S = 900.0


class Kept:
    """The rest of one process on a folder."""

    def __init__(self, folder: Path, now_s: float = 1000.0, unix_s: float = 1_700_000_100.0, boot: str = "a") -> None:
        self.machine = VirtualMachine(VirtualClock(now_s, unix_s))
        self.machine.boot_id = boot
        self.rest = Rest(folder, self.machine)

    def pulse_at(self, time_s: float, ended: bool = True) -> None:
        self.machine.run(self.rest.pulse_at(time_s, ended))

    def recalled(self, in_doubt: bool = False) -> float | None:
        self.machine.run(self.rest.recall(in_doubt))
        return self.rest.last_pulse_s

    def settled(self, after_s: float) -> float | None:
        """How long ago the last pulse was, once the device answers."""
        self.machine.wait(after_s)
        self.machine.run(self.rest.settle())
        return self.machine.clock.now_s() - (self.rest.last_pulse_s or 0.0)


@pytest.fixture
def left(tmp_path: Path) -> Path:
    """A folder with which a pulse was sent."""
    Kept(tmp_path, PULSE_S).pulse_at(PULSE_S)
    return tmp_path


@pytest.mark.parametrize("hours", [-10_000, -24, 0, 24, 10_000])
def test_a_clean_restart_remembers_whatever_the_wall_clock_says(left: Path, hours: float):
    assert Kept(left, unix_s=1_700_000_100.0 + 3600 * hours).recalled() == PULSE_S


def test_a_death_counts_from_now_and_anew_until_the_device_has_answered(left: Path):
    assert Kept(left).recalled(in_doubt=True) == 1000.0
    again = Kept(left, now_s=1010.0)
    assert again.recalled() == 1010.0
    assert again.settled(after_s=3.0) == 0.0


@pytest.mark.parametrize(
    "content",
    [
        "", "[]", "{", "null", '{"boot_id": "a"}', '{"boot_id": "another", "monotonic_s": 5}',
        '{"boot_id": "", "monotonic_s": 5}', '{"boot_id": "a", "monotonic_s": NaN}',
        '{"boot_id": "a", "monotonic_s": 1e9}', '{"boot_id": "a", "monotonic_s": -5}',
        '{"boot_id": "a", "monotonic_s": 5, "ended": false}', '{"boot_id": "another", "monotonic_s": 5, "ended": true}',
        '{"boot_id": "a", "monotonic_s": 1e9, "ended": true}', '{"boot_id": "a", "monotonic_s": NaN, "ended": true}',
    ],
)  # fmt: skip
def test_what_is_in_doubt_counts_from_now(tmp_path: Path, content: str):
    (tmp_path / "last-pulse.json").write_text(content)
    assert Kept(tmp_path).recalled() == 1000.0
    assert json.loads((tmp_path / "last-pulse.json").read_text())["monotonic_s"] == 1000.0


@pytest.mark.parametrize("boot", ["", "b"])
def test_a_machine_of_another_boot_or_one_that_does_not_tell_it_is_in_doubt(left: Path, boot: str):
    assert Kept(left, boot=boot).recalled() == 1000.0


def test_a_folder_of_an_older_version_is_in_doubt_and_a_fresh_one_is_not(tmp_path: Path):
    assert Kept(tmp_path).recalled() is None
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "20260101T000000Z_old.h5").touch()
    assert Kept(tmp_path).recalled() == 1000.0


@pytest.mark.parametrize("refuses", ["replace", "remove"])
def test_a_disk_that_refuses_leaves_no_older_time_and_raises_nothing(
    left: Path, monkeypatch: pytest.MonkeyPatch, refuses: str
):
    kept = Kept(left)
    for name in {"replace", refuses}:
        monkeypatch.setattr(Files, name, Mock(side_effect=OSError(30, "Read-only file system")))
    kept.pulse_at(1000.0)
    assert kept.rest.last_pulse_s == 1000.0
    assert (left / "last-pulse.json").exists() is (refuses == "remove")


def test_an_end_that_was_not_confirmed_counts_from_when_the_device_answers(tmp_path: Path):
    """A line that stalls may hold a pulse for longer than the process lives."""
    Kept(tmp_path).pulse_at(1000.0, ended=False)
    later = Kept(tmp_path, now_s=1005.0)
    assert later.recalled() == 1005.0
    assert later.settled(after_s=2.0) == 0.0
    assert later.settled(after_s=2.0) == 2.0, "known by now"


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
    live.machine.disk.process_ended()
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

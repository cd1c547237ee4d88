"""The rig itself, on devices in this process: from one test to the next, and what only a person may undo."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import NoneType

import h5py
import numpy as np
import pytest

from stimrig.rig.config import LimitSettings
from stimrig.rig.control import state
from stimrig.rig.control.calibration import end_of_day_s
from stimrig.rig.control.replies import refusal
from stimrig.rig.control.rig import MOST_PREVIEWS
from stimrig.rig.errors import BusyError, DeviceError, PlanError, RefusedError, RestError, UncertainError
from stimrig.rig.messages import Preview, Profile, SegmentPlan
from stimrig.rig.requests import CalibrateFinishRequest, CalibrateStartRequest, PreviewRequest
from stimrig.rig.tasks import Task
from tests.rig.live import SPEED, WORK_S, LiveRig

Make = Callable[..., LiveRig]


def test_from_ready_to_ready_with_a_sealed_file(live: LiveRig):
    assert live.start(live.plan("one")).state in ("arming", "running")
    live.wait("running")
    with pytest.raises(BusyError, match="test one of participant P"):
        live.start(live.plan("two"))
    status = live.rig.status()
    assert (status.test_id, status.participant, status.duration_s) == ("one", "P", 3.0)
    assert status.limits["current_ma"].hi == 100 and status.require_calibration is not None
    assert live.event() is not None
    assert live.rig.trouble() is None
    live.wait("ready")
    assert live.states == ["ready", "arming", "running", "sealing", "ready"]
    finished = live.finished
    assert (finished.outcome, finished.reason) == ("completed", "")
    assert finished in live.events
    assert finished.summary["warnings"] == []
    with h5py.File(str(finished.recording_path)) as file:
        assert file.attrs["test_id"] == "one"
    with pytest.raises(PlanError, match="already used"):
        live.start(live.plan("one"))
    for name in ("../two", "two\n", "", "ü", "t" * 101):
        with pytest.raises(PlanError, match="letters, digits"):
            live.start(live.plan(name))


def test_the_rest_between_two_tests_is_asked_for_and_says_how_long(live: LiveRig):
    live.play("one", hold_s=0.5)
    rested = Profile(rest_between_tests_s=60.0)
    with pytest.raises(
        RestError, match=r"rest_between_tests_s .*participant's profile, under by .*; wait 5\d"
    ) as found:
        live.start(live.plan("two", profile=rested))
    assert refusal(2, found.value).problem.code == "rest-needed", "by this a program knows that it may ask again"
    assert live.preview(live.plan("p", profile=rested)).duration_s == 3.0


def test_no_plan_is_previewed_beside_a_test_and_only_so_many_wait(live: LiveRig):
    """The next one is built once the one before is; a start waits for one, and those behind it are refused."""

    def previews(count: int) -> list[Task[Preview]]:
        return [live.begin(live.rig.preview(PreviewRequest(plan=live.plan("p")))) for _ in range(count)]

    asked = previews(2 * MOST_PREVIEWS)
    live.until(lambda: all(task.done.is_set() for task in asked))
    assert [type(task.error) for task in asked] == [NoneType] * MOST_PREVIEWS + [BusyError] * MOST_PREVIEWS
    waiting = previews(3)
    live.start(live.plan("one"))
    live.until(lambda: all(task.done.is_set() for task in waiting))
    assert [type(task.error) for task in waiting] == [NoneType, BusyError, BusyError]
    with pytest.raises(BusyError, match="test one is in progress; look at the plan afterwards"):
        live.preview(live.plan("p"))
    live.wait("ready")
    with pytest.raises(PlanError, match="at least one segment"):
        live.preview(live.plan("p", segments=[]))
    assert live.preview(live.plan("p")).duration_s == 3.0
    live.ask(live.rig.calibrations.start(CalibrateStartRequest(calibration_id="c", participant="P", by="t")))
    with pytest.raises(BusyError, match=r"^a calibration is in progress; look at the plan afterwards$"):
        live.preview(live.plan("p"))


def test_a_calibration_does_not_shorten_the_rest_after_a_test(make: Make):
    live = make(limits=LimitSettings(rest_between_tests_s=60.0))
    live.play("one", hold_s=0.5)
    live.ask(live.rig.calibrations.start(CalibrateStartRequest(calibration_id="c", participant="P", by="t")))
    with pytest.raises(RefusedError, match=r"rest_between_tests_s .*wait 5\d"):
        live.step("up")


def test_midnight_ends_nothing_in_its_middle_without_a_reason(live: LiveRig):
    midnight_s = end_of_day_s(live.clock.unix_s())
    live.clock.set_unix_ahead(midnight_s - 10.0 - live.clock.unix_s())
    with pytest.raises(PlanError, match="none is open"):
        live.step("up")
    live.ask(
        live.rig.calibrations.start(CalibrateStartRequest(calibration_id="c", participant="P", by="t", train_s=2.0))
    )
    with pytest.raises(BusyError, match="calibration"):
        live.start(live.plan("one"))
    live.step("up")
    live.wait_pulses(5)
    with pytest.raises(BusyError):
        live.step("up")
    live.clock.set_unix_ahead(midnight_s + 1.0 - live.clock.unix_s())
    live.wait("calibrating")
    assert len(live.stimulator.sent) == 80  # the train that had begun was played to its end
    finish = CalibrateFinishRequest(by="t")
    for late in (
        lambda: live.step("up"),
        lambda: live.mark("sensory"),
        lambda: live.ask(live.rig.calibrations.finish(finish)),
    ):
        with pytest.raises(RefusedError, match="began on an earlier day"):
            late()
    discarded = live.ask(live.rig.calibrations.finish(CalibrateFinishRequest(by="t", discard=True)))
    assert discarded.profile is None
    assert live.rig.player.finished is None, "a train is no test"
    assert live.rig.status().state == "ready"


def test_a_test_of_which_the_stimulator_would_send_nothing_is_refused(live: LiveRig):
    assert live.rig.status().stimulator["shortest_us"] == live.rig.pair.steps.shortest_us
    with pytest.raises(PlanError, match=r"300 µs at 0.4 mA would stimulate nothing"):
        live.start(live.plan("weak", profile=Profile(current_ma=0.4)))


def test_a_mistake_in_a_driver_is_told_as_one(live: LiveRig):
    live.start(live.plan("one", hold_s=20.0))
    live.wait_pulses(5)
    live.cell.broken = True
    assert "internal: ZeroDivisionError: a mistake in a driver" in live.wait("latched")
    live.cell.broken = False
    assert live.rearm().state == "ready"


def test_a_device_that_is_gone_is_told_and_opened_anew_by_rearming(live: LiveRig):
    live.cell.gone = True
    assert "the bus is gone" in live.wait("disconnected")
    assert live.rig.trouble() is None  # told, and waiting for a person: nothing that a restart would mend
    with pytest.raises(DeviceError, match="correct that"):
        live.start(live.plan("one"))
    with pytest.raises(DeviceError, match="not there"):
        live.rearm()
    live.cell.gone = False
    assert live.rearm().state == "ready"


def test_a_stop_of_a_deaf_device_is_not_called_confirmed(live: LiveRig):
    live.stimulator.silent = True
    assert not live.stop("check").confirmed
    assert live.rig.status().state == "latched"


def test_a_journal_without_an_end_comes_back_uncertain(make: Make, tmp_path: Path):
    live = make()
    live.start(live.plan("one", hold_s=20.0))
    live.wait_pulses(10)
    left = (tmp_path / "journals" / "one.journal").read_bytes()
    live.close()
    (tmp_path / "latch.json").unlink()
    (tmp_path / "journals" / "dead.journal").write_bytes(left.replace(b'"one"', b'"ten"'))
    again = make(armed=True)
    reason = again.wait("uncertain")
    assert "died" in reason
    assert reason.endswith("the stimulator, asked now: armed")
    assert not again.stimulator.armed  # and was stopped
    with pytest.raises(UncertainError):
        again.start(again.plan("two"))
    assert again.finished.outcome == "fault"
    assert again.rearm().state == "ready"
    with pytest.raises(RefusedError, match="rest_between_tests_s"):  # a death is no rest
        again.start(again.plan("three", profile=Profile(rest_between_tests_s=60.0)))


def test_a_damaged_journal_is_sealed_and_kept(make: Make, tmp_path: Path):
    live = make()
    live.start(live.plan("one", hold_s=20.0))
    live.wait_pulses(10)
    left = bytearray((tmp_path / "journals" / "one.journal").read_bytes())
    live.close()
    left[40] ^= 1  # in the header
    (tmp_path / "journals" / "dead.journal").write_bytes(left)
    (tmp_path / "recordings").rename(tmp_path / "elsewhere")  # the stopped test's own
    again = make()
    again.wait("uncertain")
    assert again.finished.recording_path is not None
    assert any("the journal is damaged" in words for words in again.finished.summary["warnings"])
    assert (tmp_path / "journals" / "dead.damaged").read_bytes() == left
    assert not (tmp_path / "journals" / "dead.journal").exists()


def test_a_wall_clock_that_jumps_in_a_test_changes_nothing(live: LiveRig):
    live.start(live.plan("one"))
    live.wait_pulses(10)
    for hours in (1, -2):
        live.clock.set_unix_ahead(3600 * hours)
        live.wait_pulses(10)
    live.wait("ready")
    assert live.finished.outcome == "completed"
    with h5py.File(str(live.finished.recording_path)) as file:
        times = file["pulses/written_time_s"][:]
        assert 0.4 < times[times == times].min() < times[times == times].max() < 3.0
        assert np.all(np.diff(times[times == times]) > 0)
        assert np.diff(file["torque/time_s"][:]) == pytest.approx(1 / 1600, rel=0.02)
        assert file["torque/time_s"][-1] == pytest.approx(3.0, abs=0.5)  # the jumps are of hours


def test_what_hangs_or_died_is_trouble(make: Make, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(state, "MAX_REQUEST_S", 3.0)
    live = make()
    rig = live.rig
    assert rig.trouble() is None
    live.machine.work_s = 4.0  # a plan or a disk that hangs
    hanging = live.begin(rig.start(live.plan("one", hold_s=20.0)))
    live.machine.wait(2.9 * SPEED)
    assert rig.trouble() is None  # a request may take its time
    live.machine.wait(0.2 * SPEED)
    assert rig.trouble() == "a request has been running for 3 s"
    live.machine.work_s = WORK_S
    live.until(hanging.done.is_set)
    assert rig.trouble() is None
    live.wait_pulses(5)
    assert rig.trouble() is None
    playing, rig.player.playing = rig.player.playing, live.begin(rig.rest.settle())
    live.until(rig.player.playing.done.is_set)
    assert rig.trouble() == "the task of test one ended, but its test did not"
    rig.player.playing = playing
    receiver = rig.pair.receiver
    assert receiver is not None
    receiver._closing.set()
    live.machine.wait(0.1)
    assert rig.trouble() == "the torque receiver has ended"


def test_a_rest_counts_from_when_a_stalled_line_has_answered_again(live: LiveRig):
    """The pulse that it held may have been felt only then."""
    live.start(live.plan("held"))
    live.wait("running")
    live.wait_pulses(10)
    live.stimulator.stalled = True
    live.wait("latched")
    live.machine.wait(1.2)
    live.stimulator.stalled = False
    assert live.rearm().state == "ready"
    with pytest.raises(RefusedError, match="rest_between_tests_s"):
        live.start(live.plan("soon", segments=[SegmentPlan(name="hold", sequence="steps", settings={"on_s": 1.0})]))


def test_a_stop_is_confirmed_though_the_disk_is_slow(live: LiveRig):
    live.start(live.plan("slow"))
    live.wait_pulses(5)
    live.machine.work_s = 1.0
    assert live.stop("enough").confirmed
    assert live.states[-1] == "stopping"  # nothing was written yet
    with pytest.raises(BusyError):
        live.start(live.plan("next"))
    live.wait("latched")


def test_the_watch_of_the_configuration_is_the_one_that_waits(live: LiveRig):
    assert live.config.watch.stale_torque_s == 0.5
    live.start(live.plan("one", hold_s=20.0))
    live.wait_pulses(10)
    live.cell.silent = True
    assert int(live.wait("latched").split(" ms old")[0].split()[-1]) > 450

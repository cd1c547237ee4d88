"""What comes in the middle of something else: stops and withdrawals at each moment at which a request waits."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Coroutine, Iterator
from itertools import count
from types import NoneType
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest

from stimrig.rig.control.playing import MOST_WITHDRAWN
from stimrig.rig.control.replies import refusal
from stimrig.rig.errors import (
    BusyError,
    DeviceError,
    JournalError,
    LatchChangedError,
    LatchedError,
    PlanError,
    RigError,
    WithdrawnError,
)
from stimrig.rig.requests import CalibrateStartRequest, CalibrateStepRequest, WithdrawRequest
from stimrig.rig.tasks import Task
from tests.rig.live import LiveRig
from tests.simulator.clinic import answer
from tests.simulator.disk import SimulatedDisk
from tests.simulator.world import World

Make = Callable[..., LiveRig]
Began = tuple[LiveRig, Task[Any]]
FEW = 20
"""Instants of the clock after which a wait is looked into once more."""
CALIBRATION = CalibrateStartRequest(calibration_id="c", participant="P", by="t")


@pytest.fixture
def live(make: Make) -> LiveRig:
    """On a disk that outlives it."""
    return make(disk=SimulatedDisk(World(0)))


def moments(
    make: Make,
    begin: Callable[[LiveRig], Coroutine[Any, Any, Any]],
    over: Callable[[LiveRig], bool],
    before: Callable[[LiveRig], object] = lambda _: None,
) -> Iterator[Began]:
    """A rig at each moment from when something has been asked until it is over: where it begins to wait, where it tells
    something, and every few instants."""
    for moment in count():
        live = make(disk=SimulatedDisk(World(0)), clock=None)
        before(live)
        task = live.begin(begin(live))
        if moment:
            live.until(reached(live, moment, over))
        if over(live):
            assert moment > 2, "it was over at once"
            return
        yield live, task


def reached(live: LiveRig, moment: int, over: Callable[[LiveRig], bool]) -> Callable[[], bool]:
    """Whether so many moments have passed; to be asked at each instant."""
    seen, instants = list[Any]([None]), count()

    def ended() -> bool:
        mark = live.machine.asked, len(live.events), next(instants) // FEW
        if mark != seen[-1]:
            seen.append(mark)
        return len(seen) > moment or over(live)

    return ended


def remembered(live: LiveRig) -> dict[str, str]:
    return json.loads(live.machine.disk.read(live.config.data_dir / "latch.json"))


def playing(live: LiveRig) -> bool:
    return len(live.stimulator.sent) >= 3


def ready(live: LiveRig) -> bool:
    return live.states[-1] == "ready"


def begin_test(live: LiveRig) -> Coroutine[Any, Any, Any]:
    return live.rig.start(live.plan("one", hold_s=0.5))


async def begin_train(live: LiveRig) -> None:
    await live.rig.calibrations.start(CALIBRATION)
    await live.rig.calibrations.step(CalibrateStepRequest())


def rearm_and_start(live: LiveRig) -> Coroutine[Any, Any, Any]:
    """Of a ready rig, while a start waits behind it."""
    rearming, starting = live.begin(live.rig.rearm("nurse", live.rig.state.latch)), live.begin(begin_test(live))

    async def both() -> None:
        with contextlib.suppress(LatchChangedError):
            await live.machine.tasks.join(rearming)
        await live.machine.tasks.join(starting)

    return both()


def rearm(live: LiveRig) -> Coroutine[Any, Any, Any]:
    return live.rig.rearm("nurse", live.rig.state.latch)


def stop_first(live: LiveRig) -> object:
    return live.stop("first")


def play_to_the_end(live: LiveRig) -> object:
    live.start(live.plan("one", hold_s=0.5))
    return live.wait("sealing")


STORIES = {
    "a start": (begin_test, playing, ready, {LatchedError, NoneType}),
    "a calibration and its train": (begin_train, playing, ready, {LatchedError, PlanError, NoneType}),
    "sealing": (lambda live: live.rig.library(), ready, play_to_the_end, {NoneType}),
    "re-arming": (rearm, ready, stop_first, {LatchChangedError}),
    "re-arming before a start": (rearm_and_start, playing, ready, {LatchedError, NoneType}),
}
"""What is asked for, until when, what happened before, and how it may end."""


@pytest.mark.parametrize("story", STORIES)
def test_a_stop_at_each_moment_holds_until_a_person_undoes_it(make: Make, story: str):
    begin, over, before, errors = STORIES[story]
    reason = "now (by nurse); before: first (by nurse)" if story == "re-arming" else "now (by nurse)"
    ended = set[type]()
    for live, task in moments(make, begin, over, before):
        sent, told = len(live.stimulator.sent), len(live.states)
        assert live.stop("now").confirmed
        assert live.wait("latched") == reason
        live.until(task.done.is_set)
        ended.add(type(task.error))
        live.machine.wait(2.0)
        assert len(live.stimulator.sent) == sent
        assert not live.stimulator.armed
        assert live.states[-1] == "latched" and "ready" not in live.states[told:]
        assert live.rig.status().calibration is None and live.rig.trouble() is None
        assert remembered(live) == {"state": "latched", "reason": reason}
        if story == "sealing":
            assert live.finished.outcome == "completed"
            assert live.finished.recording_path is not None
        with pytest.raises(LatchedError):
            live.start(live.plan("two"))
        assert live.rearm().state == "ready"
        assert live.states[-1] == "ready"
        assert live.play("two", hold_s=0.5).outcome == "completed"
    assert ended == errors


def test_a_stop_while_a_start_fails_holds_too(make: Make, monkeypatch: pytest.MonkeyPatch):
    """The rig is not told as ready on its way from the start that could not begin to the latch."""

    def fails(live: LiveRig) -> None:
        monkeypatch.setattr(live.rig.player.store, "begin", Mock(side_effect=JournalError("no room")))

    def given_up(live: LiveRig) -> bool:
        return "arming" in live.states and live.states[-1] == "ready"

    for live, task in moments(make, begin_test, given_up, fails):
        told = len(live.states)
        assert live.stop("now").confirmed
        live.until(task.done.is_set)
        assert isinstance(task.error, JournalError | LatchedError)
        live.machine.wait(2.0)
        assert live.states[-1] == "latched" and "ready" not in live.states[told:]
        assert remembered(live) == {"state": "latched", "reason": "now (by nurse)"}


def test_an_end_of_the_process_at_each_moment_of_a_start(make: Make):
    """It waits for no test that begins only then."""
    for live, task in moments(make, begin_test, playing):
        sent, asked_s = len(live.stimulator.sent), live.clock.now_s()
        live.close()
        assert live.clock.now_s() - asked_s < 4.0
        live.machine.wait(2.0)
        assert task.done.is_set()
        assert task.error is None or isinstance(task.error, RigError)
        assert len(live.stimulator.sent) == sent
        assert not live.stimulator.armed
        live.machine.disk.process_ended()
        again = make(disk=live.machine.disk, clock=live.clock)
        assert again.states[-1] == ("latched" if live.states[-1] == "latched" else "ready")


def test_a_start_that_was_asked_while_stopped_is_not_played_once_rearmed(make: Make):
    for live, task in moments(make, rearm, ready, stop_first):
        with pytest.raises(LatchedError):
            live.start(live.plan("early"))
        live.until(task.done.is_set)
        live.machine.wait(4.0)
        assert live.states[-1] == "ready"
        assert live.stimulator.sent == []


def test_a_latch_that_the_disk_refused_is_written_once_it_takes_it(live: LiveRig):
    """Else a rig that dies later would start as if nobody had stopped it (the simulator's seed 700251)."""
    disk: Any = live.machine.disk
    disk.failing = True
    assert live.stop("somebody pressed").confirmed
    live.machine.wait(3.0)
    with pytest.raises(FileNotFoundError):
        remembered(live)
    disk.failing = False
    live.machine.wait(2.0)
    assert remembered(live) == {"state": "latched", "reason": "somebody pressed (by nurse)"}
    assert live.rearm().state == "ready"
    live.machine.wait(5.0)
    with pytest.raises(FileNotFoundError):
        remembered(live)


def test_a_rearm_that_waits_its_turn_releases_no_stop_that_came_meanwhile(live: LiveRig):
    """Two people re-arm at once, and somebody presses stop before the second one's turn."""
    live.stop("first")
    one, two = (live.begin(live.rig.rearm(name, live.rig.state.latch)) for name in ("nurse", "doctor"))
    live.machine.wait(0.001)
    assert live.stop("second").confirmed
    live.until(two.done.is_set)
    assert all(isinstance(task.error, LatchChangedError) for task in (one, two))
    assert live.rig.status().state == "latched"
    assert remembered(live)["state"] == "latched"


def lose_the_cell(live: LiveRig) -> object:
    live.cell.gone = True
    return live.machine.wait(0.5)


AGAIN = {
    "a stop": lambda live: live.stop("it hurts", "colleague"),
    "the same stop": lambda live: live.stop("first"),
    "a fault": lambda live: live.rig.fault("stimulator: electrode error"),
    "a lost device": lose_the_cell,
}
"""What may come while it is latched, and be seen by nobody yet."""


@pytest.mark.parametrize("again", AGAIN)
def test_a_rearm_by_who_has_not_seen_the_last_stop_is_refused(live: LiveRig, again: str):
    live.stop("first")
    seen = live.rig.status().latch
    AGAIN[again](live)
    with pytest.raises(LatchChangedError, match="look at the participant and the rig, then re-arm"):
        live.ask(live.rig.rearm("nurse", seen))
    status = live.rig.status()
    assert status.state == "latched" and "first (by nurse)" in status.reason
    told = [event.status for event in live.events if event.event == "state"][-1]
    assert (told.latch, told.reason) == (status.latch, status.reason), "it is told to who looks"
    assert refusal(1, LatchChangedError("")).problem.code == "latch-changed"
    live.cell.gone = False
    assert live.ask(live.rig.rearm("nurse", status.latch)).state == "ready"


@pytest.mark.parametrize("state", ["stopping", "latched"])
def test_a_later_reason_is_told_and_outlives_the_process(make: Make, state: str):
    live = make(disk=SimulatedDisk(World(0)), clock=None)
    live.start(live.plan("one", hold_s=5.0))
    live.wait_pulses(3)
    live.begin(live.rig.stop("the session is over", "nurse"))
    live.wait(state)
    live.stop("it hurts", "colleague")
    both = "it hurts (by colleague); before: the session is over (by nurse)"
    assert live.wait("latched") == both
    assert remembered(live) == {"state": "latched", "reason": both}
    assert live.finished.reason == "the session is over (by nurse)"
    live.close()
    live.machine.disk.process_ended()
    again = make(disk=live.machine.disk, clock=live.clock)
    assert again.rig.status().reason == both
    with pytest.raises(LatchChangedError):
        again.ask(again.rig.rearm("nurse", live.rig.state.latch))  # of the process before


def test_a_stop_while_uncertain_is_told_after_the_next_restart_too(make: Make):
    live = make(disk=SimulatedDisk(World(0)), clock=None)
    live.close()
    live.machine.disk.process_ended()
    live.machine.disk.replace(live.config.data_dir / "latch.json", b"damaged")
    live = make(disk=live.machine.disk, clock=live.clock)
    seen = live.rig.state.latch
    live.stop("it hurts")
    with pytest.raises(LatchChangedError):
        live.ask(live.rig.rearm("nurse", seen))
    assert live.rig.status().state == "uncertain"
    assert remembered(live)["state"] == "running" and remembered(live)["reason"].startswith("it hurts (by nurse); ")


@pytest.mark.parametrize("begin", ["re-arming", "sealing"])
def test_a_stop_is_remembered_by_the_next_process_once_it_is_answered(make: Make, begin: str):
    """Whatever was being written when it came, and at whichever moment after its answer the process dies."""

    def before(live: LiveRig) -> None:
        live.stop("first")
        if begin == "sealing":
            live.rearm()
            live.start(live.plan("one", hold_s=0.5))
            live.wait("sealing")

    def go_on(live: LiveRig) -> Coroutine[Any, Any, Any]:
        return live.rig.rearm("nurse", live.rig.state.latch) if begin == "re-arming" else live.machine.tasks.sleep(2.0)

    for live, _ in moments(make, go_on, ready, before):
        live.stop("now")
        died = live.clock.now_s()
        while live.clock.now_s() < died + 0.3:
            latch = live.config.data_dir / "latch.json"
            left = live.machine.disk.names(live.config.data_dir / "journals")
            assert left or latch.name in live.machine.disk.names(latch.parent)
            live.machine.wait(0.001)


def test_a_bug_while_a_tests_files_are_made_leaves_a_rig_that_can_be_stopped(live: LiveRig, monkeypatch: Any):
    monkeypatch.setattr(live.rig.store, "begin", Mock(side_effect=ValueError("a mistake in this program")))
    with pytest.raises(ValueError, match="mistake"):
        live.start(live.plan("one"))
    assert live.rig.status().state == "ready"
    assert live.stop("now").confirmed


def test_nothing_begins_while_the_rig_shuts_down(live: LiveRig):
    closing = live.begin(live.rig.close())
    live.machine.wait(0.001)
    with pytest.raises(BusyError, match="shutting down"):
        live.rearm()
    live.until(closing.done.is_set)
    assert live.stimulator.sent == []


def test_a_stimulator_that_can_still_stimulate_is_not_rearmed(live: LiveRig, monkeypatch: Any):
    live.stop("now")

    async def state() -> tuple[bool, str]:
        return False, "stimulating"

    monkeypatch.setattr(live.stimulator, "state", state)
    with pytest.raises(DeviceError, match="still says stimulating"):
        live.rearm()
    assert live.rig.status().state == "latched"


WHY = "withdrawn: signed out"


def withdraw(live: LiveRig, test_id: str = "one", begun: bool = False) -> bool:
    request = WithdrawRequest(test_id=test_id, reason="signed out", begun=begun)
    return live.ask(live.rig.player.withdraw(request)).withdrawn


def test_at_each_moment_before_its_first_pulse_it_plays_none_and_does_not_latch(make: Make):
    ended = set[type]()
    for live, task in moments(make, begin_test, lambda live: bool(live.stimulator.sent)):
        assert withdraw(live)
        live.until(task.done.is_set)
        ended.add(type(task.error))
        live.wait("ready")
        live.machine.wait(2.0)
        assert live.stimulator.sent == [] and not live.stimulator.armed
        assert "latched" not in live.states and live.rig.status().reason == ""
        with pytest.raises(FileNotFoundError):
            remembered(live)
        if task.error is None:
            assert (live.finished.outcome, live.finished.reason) == ("stopped", WHY)
            assert live.finished.summary["ended_by"] == "withdrawn"
        assert live.play("two", hold_s=0.5).outcome == "completed"
    assert ended == {WithdrawnError, type(None)}


@pytest.mark.parametrize("begun", [False, True])
def test_one_that_has_begun_ends_only_where_that_is_asked(make: Make, begun: bool):
    live = make()
    live.start(live.plan("one", hold_s=1.0))
    live.wait_pulses(5)
    assert withdraw(live, begun=begun) is begun
    sent = len(live.stimulator.sent)
    live.wait("ready")
    finished = live.finished
    if not begun:
        assert finished.outcome == "completed" and len(live.stimulator.sent) == 40
        return
    assert len(live.stimulator.sent) == sent and not live.stimulator.armed
    assert (finished.outcome, finished.reason) == ("stopped", WHY)
    assert finished.summary["pulses"] == sent and finished.summary["charge_uc"] > 0
    with h5py.File(str(finished.recording_path)) as file:
        assert file.attrs["outcome"] == "stopped"
        assert np.sum(np.asarray(file["pulses/status"]) == 0) == sent
        assert "withdrawn" in [event["event"] for event in json.loads(str(file.attrs["events"]))]


def test_it_holds_for_a_test_that_the_rig_has_not_heard_of_yet(live: LiveRig):
    reply = live.ask(answer(live.rig, b'{"kind": "withdraw", "id": 3, "test_id": "one", "reason": "signed out"}'))
    assert reply.ok and reply.body == {"withdrawn": True}
    with pytest.raises(WithdrawnError, match="test one: withdrawn: signed out; ask for a new test"):
        live.start(live.plan("one"))
    assert live.states == ["ready"] and WithdrawnError.code == "withdrawn"
    for number in range(MOST_WITHDRAWN):
        assert withdraw(live, f"other-{number}")
    assert len(live.rig.player.withdrawals) == MOST_WITHDRAWN
    assert list(live.rig.player.withdrawals)[-1] == f"other-{MOST_WITHDRAWN - 1}", "the oldest is forgotten"
    with pytest.raises(PlanError, match="letters, digits"):
        withdraw(live, "../one")


def test_of_one_that_is_over_nothing_is_withdrawn(live: LiveRig):
    live.start(live.plan("one", hold_s=0.5))
    live.wait("sealing")
    assert not withdraw(live, begun=True)
    live.wait("ready")
    assert not withdraw(live, begun=True)
    assert live.finished.outcome == "completed"


def test_a_stop_outranks_it(live: LiveRig):
    live.start(live.plan("one", hold_s=5.0))
    live.wait_pulses(5)
    assert withdraw(live, begun=True)
    assert live.stop("it hurts").confirmed
    assert live.wait("latched") == "it hurts (by nurse)"
    assert remembered(live)["state"] == "latched"

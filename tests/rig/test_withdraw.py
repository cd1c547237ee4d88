"""A test that is withdrawn plays no pulse, and nobody has to re-arm for it."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.rig.control.playing import MOST_WITHDRAWN
from stimrig.rig.errors import PlanError, WithdrawnError
from stimrig.rig.messages import WithdrawRequest
from tests.rig.live import LiveRig
from tests.rig.test_races import begin_test, moments, remembered
from tests.simulator.clinic import answer
from tests.simulator.disk import SimulatedDisk
from tests.simulator.world import World

Make = Callable[..., LiveRig]
WHY = "withdrawn: signed out"


def withdraw(live: LiveRig, test_id: str = "one", begun: bool = False) -> bool:
    request = WithdrawRequest(test_id=test_id, reason="signed out", begun=begun)
    return live.ask(live.rig.player.withdraw(request)).withdrawn


def one_pulse(live: LiveRig) -> bool:
    return bool(live.stimulator.sent)


def test_at_each_moment_before_its_first_pulse_it_plays_none_and_does_not_latch(make: Make):
    ended = set[type]()
    for live, task in moments(make, begin_test, one_pulse):
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
            assert live.rig.finished is not None
            assert (live.rig.finished.outcome, live.rig.finished.reason) == ("stopped", WHY)
            assert live.rig.finished.summary["ended_by"] == "withdrawn"
        live.start(live.plan("two", hold_s=0.5))
        live.wait("ready")
        assert live.rig.finished is not None and live.rig.finished.outcome == "completed"
    assert ended == {WithdrawnError, type(None)}


@pytest.mark.parametrize("begun", [False, True])
def test_one_that_has_begun_ends_only_where_that_is_asked(make: Make, begun: bool):
    live = make()
    live.start(live.plan("one", hold_s=1.0))
    live.wait_pulses(5)
    assert withdraw(live, begun=begun) is begun
    sent = len(live.stimulator.sent)
    live.wait("ready")
    finished = live.rig.finished
    assert finished is not None
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


def test_it_holds_for_a_test_that_the_rig_has_not_heard_of_yet(make: Make):
    live = make()
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


def test_of_one_that_is_over_nothing_is_withdrawn(make: Make):
    live = make()
    live.start(live.plan("one", hold_s=0.5))
    live.wait("sealing")
    assert not withdraw(live, begun=True)
    live.wait("ready")
    assert not withdraw(live, begun=True)
    assert live.rig.finished is not None and live.rig.finished.outcome == "completed"


def test_a_stop_outranks_it(make: Make):
    live = make(disk=SimulatedDisk(World(0)))
    live.start(live.plan("one", hold_s=5.0))
    live.wait_pulses(5)
    assert withdraw(live, begun=True)
    assert live.stop("it hurts").confirmed
    assert live.wait("latched") == "it hurts (by nurse)"
    assert remembered(live)["state"] == "latched"


def test_an_end_that_the_stimulator_does_not_confirm_is_a_fault(make: Make, monkeypatch: Any):
    live = make()
    live.start(live.plan("one", hold_s=5.0))
    live.wait_pulses(5)

    async def state() -> tuple[bool, str]:
        return False, "stimulating"

    monkeypatch.setattr(live.stimulator, "state", state)
    assert withdraw(live, begun=True)
    assert "the end of stimulation is not confirmed" in live.wait("latched")

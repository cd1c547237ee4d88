"""The state machine: no way out of a latch but a person, whatever happens in whatever order."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import BusyError, DeviceError, LatchedError, RigError, UncertainError
from rig.trial import Trial

STEPS = {
    "start": lambda t: t.start("id", "P"),
    "armed": lambda t: t.armed(),
    "fault": lambda t: t.halted("why"),
    "lost": lambda t: t.disconnected("gone"),
    "ended": lambda t: t.ended(),
    "sealed": lambda t: t.sealed(),
    "connected": lambda t: t.connected(),
}


def test_a_test_from_start_to_end():
    trial = Trial().connected().start("a", "P")
    assert (trial.state, trial.test_id, trial.busy) == ("arming", "a", True)
    trial = trial.armed()
    assert trial.state == "running"
    trial = trial.ended()
    assert trial.state == "sealing"
    assert trial.sealed() == Trial("ready", "")


@given(st.lists(st.sampled_from(sorted(STEPS)), max_size=30))
def test_after_a_fault_nothing_starts_without_a_person(steps: list[str]):
    trial = Trial().connected().start("a", "P").armed().halted("the fault")
    for step in steps:
        try:
            trial = STEPS[step](trial)
        except RigError:
            continue
        assert trial.state in ("stopping", "sealing", "latched")
    with pytest.raises(RigError):
        trial.start("b", "P")


@given(st.lists(st.sampled_from(sorted(STEPS)), max_size=30))
def test_uncertain_stays_uncertain(steps: list[str]):
    trial = Trial().connected("uncertain", "died")
    for step in steps:
        try:
            trial = STEPS[step](trial)
        except RigError:
            continue
        assert trial.state == "uncertain"
    assert trial.rearm().state == "ready"


def test_refusals_say_why():
    running = Trial().connected().start("mine", "P7").armed()
    with pytest.raises(BusyError, match="mine of participant P7"):
        running.start("x", "P")
    with pytest.raises(BusyError):
        running.rearm()
    with pytest.raises(LatchedError, match="electrode"):
        Trial().connected().halted("electrode").start("x", "P")
    with pytest.raises(UncertainError, match="died"):
        Trial().connected("uncertain", "died").start("x", "P")
    with pytest.raises(DeviceError, match="no port"):
        Trial().connected().disconnected("no port").start("x", "P")


def test_what_was_remembered_comes_back():
    assert Trial().connected("latched", "why").state == "latched"
    assert Trial().connected("running", "why").state == "uncertain"


def test_a_device_lost_in_a_test_shows_after_it():
    trial = Trial().connected().start("a", "P").armed().disconnected("gone")
    assert trial.state == "running"
    assert trial.ended().sealed() == Trial("disconnected", "gone")
    latched = trial.halted("gone").ended().sealed()
    assert (latched.state, latched.lost) == ("latched", "gone")


def test_a_stop_while_sealing_latches_afterwards():
    trial = Trial().connected().start("a", "P").armed().ended().halted("stop")
    assert trial.state == "sealing"
    assert trial.sealed().state == "latched"

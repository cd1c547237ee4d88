"""The state machine: no way out of a latch but a person, whatever happens in whatever order."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig.rig.errors import BusyError, DeviceError, LatchedError, RigError, UncertainError
from stimrig.rig.phase import LONGEST_REASON, Phase, TransitionError

STEPS = {
    "start": lambda t: t.start("id", "P"),
    "armed": lambda t: t.armed(),
    "fault": lambda t: t.halted("why"),
    "lost": lambda t: t.disconnected("gone"),
    "ended": lambda t: t.ended(),
    "sealed": lambda t: t.sealed(),
    "connected": lambda t: t.connected(),
}


def after(phase: Phase, steps: list[str], *states: str) -> Phase:
    """What it is after those of the steps that may be taken; it is in one of the states all the time."""
    for step in steps:
        with contextlib.suppress(RigError):
            phase = STEPS[step](phase)
        assert phase.state in states
    return phase


@given(st.lists(st.sampled_from(sorted(STEPS)), max_size=30))
def test_after_a_fault_nothing_starts_without_a_person(steps: list[str]):
    halted = Phase().connected().start("a", "P").armed().halted("the fault")
    with pytest.raises(RigError):
        after(halted, steps, "stopping", "sealing", "latched").start("b", "P")


@given(st.lists(st.sampled_from(sorted(STEPS)), max_size=30))
def test_uncertain_stays_uncertain(steps: list[str]):
    assert after(Phase().connected("uncertain", "died"), steps, "uncertain").rearm().state == "ready"


ARMING = Phase("arming", "", "a", "P")
STOPPING = Phase("stopping", "why", "a", "P", latch=True)
SEALING = replace(STOPPING, state="sealing")
CALIBRATING = Phase("calibrating", "", None, "P", calibrating=True)
TRAIN = replace(CALIBRATING, state="arming", test_id="c.001")
READY = Phase("ready", "")
LATCHED = Phase("latched", "why")
UNCERTAIN = Phase("uncertain", "died")

EVERY_STATE = (
    Phase("disconnected", "gone"), READY, CALIBRATING, ARMING, TRAIN, replace(ARMING, state="running"),
    replace(TRAIN, state="running"), STOPPING, replace(ARMING, state="sealing"), replace(TRAIN, state="sealing"),
    SEALING, LATCHED, UNCERTAIN,
)  # fmt: skip


@pytest.mark.parametrize("phase", EVERY_STATE, ids=lambda t: f"{t.state}-{t.test_id}")
def test_each_step_is_taken_from_its_own_states_alone(phase: Phase):
    """A step from any other state is a fault in the program: it raises, and names both."""
    for step, states in {
        "connected": ("disconnected",),
        "armed": ("arming",),
        "withdrawn": ("arming", "running"),
        "ended": ("running", "stopping", "arming"),
        "sealed": ("sealing",),
        "calibrated": ("calibrating",),
    }.items():
        if phase.state in states:
            getattr(phase, step)()
            continue
        with pytest.raises(TransitionError) as raised:
            getattr(phase, step)()
        assert str(raised.value) == f"the rig is {phase.state}, this step needs {' or '.join(states)}"
    if phase.state != "calibrating":
        with pytest.raises(TransitionError, match="needs calibrating"):
            phase.train("c.001")


def test_what_each_step_gives():
    assert Phase().connected() == READY
    assert Phase().connected("latched", "why") == LATCHED
    assert Phase().connected("latched") == Phase("latched", "")
    assert Phase() == Phase("disconnected", "not connected yet", None, None, latch=False, lost="", calibrating=False)
    assert Phase().connected("running", "died") == UNCERTAIN
    assert READY.start("a", "P") == ARMING
    assert READY.calibrate("P") == CALIBRATING
    assert CALIBRATING.train("c.001") == TRAIN
    assert CALIBRATING.calibrated() == READY
    for begun in (ARMING, TRAIN):
        assert begun.armed() == replace(begun, state="running")
        assert begun.ended() == begun.armed().ended() == replace(begun, state="sealing")
        assert begun.withdrawn() == begun.armed().withdrawn() == replace(begun, state="stopping"), "no latch"
    assert STOPPING.ended() == SEALING


def test_where_the_sealing_leads():
    assert replace(ARMING, state="sealing").sealed() == READY
    assert replace(TRAIN, state="sealing").sealed() == CALIBRATING
    assert SEALING.sealed() == LATCHED
    assert replace(SEALING, lost="gone").sealed() == replace(LATCHED, lost="gone")
    assert replace(TRAIN, state="sealing", lost="gone").sealed() == Phase("disconnected", "gone")


def test_a_stop_leads_to_the_latch_from_everywhere_and_every_reason_is_told_the_newest_first():
    for begun in (ARMING, TRAIN, replace(ARMING, state="running"), replace(TRAIN, state="running")):
        assert begun.halted("why") == replace(begun, state="stopping", reason="why", latch=True)
    for ending in (STOPPING, SEALING):
        assert ending.halted("another") == replace(ending, reason="another; before: why")
        assert ending.halted("why") == ending
    assert replace(ARMING, state="sealing").halted("why") == SEALING
    assert READY.halted("why") == CALIBRATING.halted("why") == LATCHED
    for stopped in (LATCHED, UNCERTAIN):
        more = stopped.halted("another")
        assert more == replace(stopped, reason=f"another; before: {stopped.reason}")
        assert more.halted(stopped.reason).reason == f"{stopped.reason}; before: another"
    assert Phase("disconnected", "gone").halted("why") == replace(LATCHED, lost="gone")


def test_reasons_are_told_up_to_a_length_and_the_newest_is_never_cut():
    phase = LATCHED
    for number in range(100):
        phase = phase.halted(f"{number} {'x' * 600}")
    assert len(phase.reason) == LONGEST_REASON
    assert phase.reason.startswith(f"99 {'x' * 600}; before: 98 x")


def test_a_lost_device_is_remembered_until_the_end_of_a_test_and_while_a_person_is_awaited():
    for phase in EVERY_STATE:
        waits = phase.busy or phase.state in ("latched", "uncertain")
        assert phase.disconnected("unplugged") == (
            replace(phase, lost="unplugged") if waits else Phase("disconnected", "unplugged")
        )


@pytest.mark.parametrize("phase", EVERY_STATE, ids=lambda t: f"{t.state}-{t.test_id}")
def test_a_start_is_refused_in_every_state_but_ready(phase: Phase):
    look = "look at the participant and the rig, then re-arm"
    expected = {
        "calibrating": (BusyError, "a calibration of participant P is open; finish or discard it"),
        "latched": (LatchedError, f"why; {look}"),
        "uncertain": (UncertainError, f"died; {look}"),
        "disconnected": (DeviceError, "gone; correct that, then re-arm"),
    }.get(phase.state, (BusyError, f"test {phase.test_id} of participant P is {phase.state}; wait or stop it"))
    if phase.state == "ready":
        phase.may_start()
        return
    for begin in (phase.may_start, lambda: phase.start("b", "Q"), lambda: phase.calibrate("Q")):
        with pytest.raises(RigError) as raised:
            begin()
        assert (type(raised.value), str(raised.value)) == expected


@pytest.mark.parametrize("phase", EVERY_STATE, ids=lambda t: f"{t.state}-{t.test_id}")
def test_rearming_ends_no_test_and_no_calibration(phase: Phase):
    if not phase.busy and phase.state != "calibrating":
        assert phase.rearm() == READY
        return
    what = f"test {phase.test_id} is {phase.state}" if phase.busy else "a calibration of participant P is open"
    with pytest.raises(BusyError) as raised:
        phase.rearm()
    assert str(raised.value) == f"{what}; nothing to re-arm"

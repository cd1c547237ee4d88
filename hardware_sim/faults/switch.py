"""Faults of the switch between stimulator and array."""

from __future__ import annotations

from stimrig.hardware_sim.errors import FaultError
from stimrig.hardware_sim.faults import Target, Undo, fault, hooked, sometimes
from stimrig.hardware_sim.switch import RelayMatrix


@fault
def switch_relay_stuck(target: Target, relay: float = 1.0, closed: bool = True) -> Undo:
    """One relay stays closed, or open, whatever it is told."""
    switch, number = _switch(target), int(relay)
    if number != relay or not 1 <= number <= switch.relays:
        raise FaultError(f"setting 'relay' of fault 'switch_relay_stuck' must be 1 to {switch.relays}, not {relay:g}")
    switch.stuck[number] = closed

    def free() -> None:
        switch.stuck.pop(number, None)

    return free


@fault
def switch_silent(target: Target) -> Undo:
    """The switch obeys but answers nothing."""
    return hooked(lambda _answer: None, _switch(target).outgoing)


@fault
def switch_wrong_answer(target: Target, probability: float = 1.0) -> Undo:
    """The first digit of an answer is another one, with this probability."""
    other = str.maketrans("01", "10")
    wrong = sometimes(target, probability, lambda answer: answer[:1].translate(other) + answer[1:])
    return hooked(wrong, _switch(target).outgoing)


def _switch(target: Target) -> RelayMatrix:
    if target.switch is None:
        raise FaultError("this rig has no switch; start it with --array")
    return target.switch

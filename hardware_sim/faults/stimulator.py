"""Faults of the stimulator and its line."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

from stimrig.hardware_sim.faults import Target, Undo, fault, hook, replaced

HALF_A_FRAME = bytes.fromhex("f0815581")
STOPS = 4, 34
"""Commands that stop stimulation, of ScienceMode 4's low level and of ScienceMode 2."""
answers, commands = attrgetter("board.outgoing"), attrgetter("board.incoming")
"""Hooks of the frames to the host, and of the bytes from it."""


@fault
def stimulator_unplugged(target: Target, mid_frame: bool = True) -> Undo:
    """The cable is pulled after half a frame was sent. When undone, the port is back under another name."""
    if mid_frame:
        target.board.write(HALF_A_FRAME)
    target.plug_stimulator(False)
    return target.plug_stimulator


@hook(answers)
def no_ack(target: Target) -> Any:  # noqa: ARG001
    """The stimulator obeys but answers nothing."""
    return lambda _frame: None


@hook(answers)
def late_ack(target: Target, delay_s: float = 0.2) -> Any:
    """The stimulator's answers come `delay_s` late."""

    def delay(frame: bytes) -> None:
        target.timeline.after(delay_s, lambda: target.board.write(frame))

    return delay


@fault
def electrode_error(target: Target) -> Undo:
    """An electrode has come off."""
    return replaced(target.board.electrodes, "attached", False)


@fault
def emergency_switch(target: Target) -> Undo:
    """The emergency switch is pressed: a RehaStim 2 reports it, a P24 sees open electrodes."""
    return replaced(target.board.electrodes, "cut", True)


@fault
def high_voltage_error(target: Target) -> Undo:
    """The high-voltage source fails; in a RehaStim 2, the stimulation module."""
    return replaced(target.board, "high_voltage_works", False)


@fault
def device_reset(target: Target, mid_frame: bool = False) -> Undo:
    """The stimulator restarts once. Its port stays, and nothing is initialised any more."""
    if mid_frame:
        target.board.write(HALF_A_FRAME)
    target.firmware.reset()
    return lambda: None


@hook(commands)
def stop_lost(target: Target, within_s: float = 5.0) -> Any:
    """A stop that comes within so many seconds of a pulse is lost, and nobody answers it."""
    wire, log = target.firmware.wire(), target.board.electrodes.log

    def lose(data: bytes) -> bytes | None:
        now_s = target.timeline.now_s
        if not any(packet.command in STOPS for packet in wire.feed(data, now_s)):
            return data
        return None if log and now_s - log[-1].time_s < within_s else data

    return lose

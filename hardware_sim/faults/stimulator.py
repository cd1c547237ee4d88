"""Faults of the stimulator and its line."""

from __future__ import annotations

from stimrig.hardware_sim.faults import Target, Undo, fault, hooked, replaced, sometimes

HALF_A_FRAME = bytes.fromhex("f0815581")


@fault
def stimulator_unplugged(target: Target, mid_frame: bool = True) -> Undo:
    """The cable is pulled after half a frame was sent. When undone, the port is back under another name."""
    if mid_frame:
        target.board.write(HALF_A_FRAME)
    target.plug_stimulator(False)
    return target.plug_stimulator


@fault
def no_ack(target: Target) -> Undo:
    """The stimulator obeys but answers nothing."""
    return hooked(lambda _frame: None, target.board.outgoing)


@fault
def late_ack(target: Target, delay_s: float = 0.2) -> Undo:
    """The stimulator's answers come `delay_s` late."""

    def delay(frame: bytes) -> None:
        target.timeline.after(delay_s, lambda: target.board.write(frame))

    return hooked(delay, target.board.outgoing)


@fault
def line_stalled(target: Target, to_device: bool = True, to_host: bool = True) -> Undo:
    """The line stores all bytes in one direction or both. When undone, it delivers all of them at once."""
    commands, answers = bytearray(), bytearray()
    undo = []
    if to_device:
        undo.append(hooked(lambda data: commands.extend(data), target.board.incoming))
    if to_host:
        undo.append(hooked(lambda data: answers.extend(data), target.board.outgoing))

    def deliver() -> None:
        for take_out in undo:
            take_out()
        if answers:
            target.board.write(bytes(answers))
        if commands:
            target.firmware.received(bytes(commands))

    return deliver


@fault
def frames_doubled(target: Target, probability: float = 1.0) -> Undo:
    """Deliver bytes from the host twice, with this probability for each piece read."""
    return hooked(sometimes(target, probability, lambda data: data * 2), target.board.incoming)


@fault
def corrupt_answers(target: Target, probability: float = 1.0) -> Undo:
    """One byte of an answer is changed, with this probability."""
    return hooked(lambda frame: _corrupted(target, frame, probability), target.board.outgoing)


@fault
def corrupt_commands(target: Target, probability: float = 1.0) -> Undo:
    """One byte of what the host sends is changed, with this probability for each piece read."""
    return hooked(lambda data: _corrupted(target, data, probability), target.board.incoming)


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


@fault
def stop_lost(target: Target, within_s: float = 5.0) -> Undo:
    """A stop that comes within so many seconds of a pulse is lost, and nobody answers it."""
    wire, log = target.firmware.wire(), target.board.electrodes.log

    def lose(data: bytes) -> bytes | None:
        now_s = target.timeline.now_s
        if not any(packet.command in STOPS for packet in wire.feed(data, now_s)):
            return data
        return None if log and now_s - log[-1].time_s < within_s else data

    return hooked(lose, target.board.incoming)


STOPS = 4, 34
"""Commands that stop stimulation, of ScienceMode 4's low level and of ScienceMode 2."""


def _corrupted(target: Target, data: bytes, probability: float) -> bytes:
    if not data or target.random.random() >= probability:
        return data
    corrupted = bytearray(data)
    corrupted[target.random.randrange(len(data))] ^= target.random.randrange(1, 256)
    return bytes(corrupted)

"""What breaks on the stimulator's side."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hardware_sim.faults.registry import Undo, fault, hooked

if TYPE_CHECKING:
    from hardware_sim.emulator import Emulator

HALF_A_FRAME = bytes.fromhex("f0815581")


@fault
def stimulator_unplugged(emulator: Emulator, mid_frame: bool = True) -> Undo:
    """The cable is pulled, with half a frame on it; undone, the port is back under another name."""
    if mid_frame:
        emulator.port.write(HALF_A_FRAME)
    emulator.unplug_stimulator()
    return emulator.plug_stimulator


@fault
def no_ack(emulator: Emulator) -> Undo:
    """The stimulator obeys but answers nothing."""
    return hooked(emulator.board.outgoing, lambda _frame: None)


@fault
def late_ack(emulator: Emulator, delay_s: float = 0.2) -> Undo:
    """The stimulator's answers come `delay_s` late."""

    def keep_back(frame: bytes) -> None:
        emulator.timeline.after(delay_s, lambda: emulator.board.write(frame))

    return hooked(emulator.board.outgoing, keep_back)


@fault
def line_stalled(emulator: Emulator, to_device: bool = True, to_host: bool = True) -> Undo:
    """The line holds what it is given, in either direction or both, and lets all of it go at once when undone."""
    commands, answers = bytearray(), bytearray()

    def hold(kept: bytearray, data: bytes) -> None:
        kept.extend(data)

    undo = []
    if to_device:
        undo.append(hooked(emulator.board.incoming, lambda data: hold(commands, data)))
    if to_host:
        undo.append(hooked(emulator.board.outgoing, lambda data: hold(answers, data)))

    def let_go() -> None:
        for take_out in undo:
            take_out()
        if answers:
            emulator.board.write(bytes(answers))
        if commands:
            emulator.firmware.received(bytes(commands))

    return let_go


@fault
def frames_doubled(emulator: Emulator, probability: float = 1.0) -> Undo:
    """What the host sends arrives twice, with this probability for each piece read."""
    return hooked(emulator.board.incoming, lambda data: data * 2 if emulator.random.random() < probability else data)


@fault
def corrupt_answers(emulator: Emulator, probability: float = 1.0) -> Undo:
    """One byte of an answer is another, with this probability."""
    return hooked(emulator.board.outgoing, lambda frame: _garble(emulator, frame, probability))


@fault
def corrupt_commands(emulator: Emulator, probability: float = 1.0) -> Undo:
    """One byte of what the host sends is another, with this probability for each piece read."""
    return hooked(emulator.board.incoming, lambda data: _garble(emulator, data, probability))


@fault
def electrode_error(emulator: Emulator) -> Undo:
    """An electrode has come off."""

    def back() -> None:
        emulator.electrodes.attached = True

    emulator.electrodes.attached = False
    return back


@fault
def emergency_switch(emulator: Emulator) -> Undo:
    """The emergency switch is pressed: a RehaStim 2 says so, a P24 sees open electrodes."""

    def back() -> None:
        emulator.electrodes.cut = False

    emulator.electrodes.cut = True
    return back


@fault
def high_voltage_error(emulator: Emulator) -> Undo:
    """The high-voltage source fails; of a RehaStim 2, the stimulation module."""

    def back() -> None:
        emulator.board.high_voltage_works = True

    emulator.board.high_voltage_works = False
    return back


@fault
def device_reset(emulator: Emulator, mid_frame: bool = False) -> Undo:
    """The stimulator starts anew, once, with its port staying; nothing is initialised any more."""
    if mid_frame:
        emulator.board.write(HALF_A_FRAME)
    emulator.firmware.reset()
    return lambda: None


def _garble(emulator: Emulator, data: bytes, probability: float) -> bytes:
    if not data or emulator.random.random() >= probability:
        return data
    garbled = bytearray(data)
    garbled[emulator.random.randrange(len(data))] ^= emulator.random.randrange(1, 256)
    return bytes(garbled)

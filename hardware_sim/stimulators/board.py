"""The hardware that a firmware runs on: time, the line to the host, the electrodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from stimrig.hardware_sim.patients.muscle import Muscle
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode
from stimrig.hardware_sim.timeline import Timeline

FrameHook = Callable[[bytes], bytes | None]
"""A fault on the line: takes a frame and returns what is sent instead; None sends nothing."""
Point = tuple[int, float]
"""One piece of a pulse's shape: duration in µs, current in mA."""
Output = tuple[int, int]
"""Connector and channel, from 0."""
FIRST: Output = (0, 0)
"""The output with the pair of electrodes."""


@dataclass(frozen=True)
class FiredPulse:
    """A pulse that the stimulator fired, as the muscle sees it: one phase's width and current."""

    time_s: float
    width_us: float
    current_ma: float
    delivered: bool
    balanced: bool
    output: Output = (0, 0)


class Electrodes:
    """One pair on one muscle, at the stimulator's first output.

    `raise_sync` is called for each pulse that flows. `cut` is the emergency switch: some devices report it, to the
    others it looks like an open electrode.
    """

    def __init__(self, muscle: Muscle, raise_sync: Callable[[], None] = lambda: None) -> None:
        self.attached = True
        self.cut = False
        self.unbalanced_pulses = 0
        self.log: list[FiredPulse] = []
        self._muscle = muscle
        self._raise_sync = raise_sync

    def fire(self, time_s: float, points: Sequence[Point], output: Output) -> bool:
        """One pulse of this shape; True if it flowed through the muscle."""
        width_us, current_ma, balanced = phase(points)
        flows = self.attached and not self.cut and output == FIRST and width_us > 0
        self.log.append(FiredPulse(time_s, width_us, current_ma, flows, balanced, output))
        if not balanced:
            self.unbalanced_pulses += 1
        if flows:
            self._muscle.pulse(time_s, width_us, current_ma)
            self._raise_sync()
        return flows

    def pulses(self, since: int = 0) -> list[dict[str, Any]]:
        """The log from entry `since` on, as plain values."""
        return [asdict(pulse) for pulse in self.log[since:]]


def phase(points: Sequence[Point]) -> tuple[float, float, bool]:
    """Width (µs) and mean current (mA) of a shape's positive phase, and whether its charge sums to zero.

    The negative phase counts if there is no positive one: nerves respond to both.
    """
    net_us_ma = sum(width * current for width, current in points)
    for sign in (1, -1):
        width_us = sum(width for width, current in points if sign * current > 0)
        if width_us > 0:
            charge = sum(width * abs(current) for width, current in points if sign * current > 0)
            return float(width_us), charge / width_us, net_us_ma == 0
    return 0.0, 0.0, True


class Board:
    """The hardware under a firmware. Faults act here, so that no firmware needs to know them.

    `write` sends bytes to the host, `unread` returns how many of them the host has not read.
    """

    def __init__(
        self,
        timeline: Timeline,
        electrodes: Electrodes,
        write: Callable[[bytes], None],
        unread: Callable[[], int] = lambda: 0,
    ) -> None:
        self.timeline = timeline
        self.electrodes = electrodes
        self.write = write
        self.unread = unread
        self.high_voltage_works = True
        self.outgoing: list[FrameHook] = []
        self.incoming: list[FrameHook] = []

    def send(self, frame: bytes) -> None:
        """One frame to the host."""
        sent: bytes | None = frame
        for hook in self.outgoing:
            if sent is None:
                return
            sent = hook(sent)
        if sent:
            self.write(sent)


class Firmware:
    """Base of the stimulators' firmwares: commands in, packets out."""

    device: ClassVar[str]
    wire: ClassVar[type[ScienceMode]]

    def __init__(self, board: Board) -> None:
        self._board = board
        self._wire: Any = self.wire()
        self.commands: Counter[int] = Counter()
        """Count of each command received."""

    def received(self, data: bytes) -> None:
        """Bytes from the host, at the timeline's time."""
        raise NotImplementedError

    def reset(self) -> None:
        """Power lost and back: no stimulation, nothing initialised, commands forgotten."""
        raise NotImplementedError

    def mode(self) -> tuple[str, bool]:
        """What it is ready for, and whether high voltage is on."""
        raise NotImplementedError

    def state(self) -> dict[str, Any]:
        """For the control line."""
        mode, high_voltage_on = self.mode()
        return {
            "device": self.device,
            "mode": mode,
            "high_voltage_on": high_voltage_on,
            "corrupt_frames": self._wire.corrupt_frames,
            "commands": {str(command): count for command, count in sorted(self.commands.items())},
        }

    def _send(self, number: int, command: int, data: bytes) -> None:
        self._board.send(self._wire.encode(Packet(number, command, data)))

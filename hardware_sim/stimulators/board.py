"""The hardware that a firmware runs on: time, the line to the host, the electrodes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Any, ClassVar

from stimrig.hardware_sim.electrodes import Electrodes
from stimrig.hardware_sim.timeline import Timeline

FrameHook = Callable[[bytes], bytes | None]
"""A fault on the line: takes a frame and returns what is sent instead; None sends nothing."""


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


class Firmware(ABC):
    """What every stimulator's firmware offers, by the commands that it takes."""

    device: ClassVar[str]

    def __init__(self, board: Board) -> None:
        self._board = board
        self.commands: Counter[int] = Counter()
        """How often each came."""

    @abstractmethod
    def received(self, data: bytes) -> None:
        """Bytes from the host, at the timeline's time."""

    @abstractmethod
    def reset(self) -> None:
        """Power lost and back: no stimulation, nothing initialised, commands forgotten."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """For the control line: at least `mode` and `high_voltage_on`."""

    def _describe(self, mode: str, high_voltage_on: bool, corrupt_frames: int) -> dict[str, Any]:
        return {
            "device": self.device,
            "mode": mode,
            "high_voltage_on": high_voltage_on,
            "corrupt_frames": corrupt_frames,
            "commands": {str(command): count for command, count in sorted(self.commands.items())},
        }

"""The hardware that a firmware runs on: time, the line to the host, the electrodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

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


class FirmwareProtocol(Protocol):
    """What every stimulator's firmware offers; its constructor takes the `Board`."""

    def received(self, data: bytes) -> None:
        """Bytes from the host, at the timeline's time."""
        ...

    def reset(self) -> None:
        """Power lost and back: no stimulation, nothing initialised."""
        ...

    def state(self) -> dict[str, Any]:
        """For the control line: at least `mode` and `high_voltage_on`."""
        ...

"""The only way to end a test early: the first reason counts, and wakes the sender at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from rig.clock import Clock
from rig.tasks import Signal

Cause = Literal["stopped", "fault"]


class Halt:
    """Set once; `signal` wakes all who wait."""

    def __init__(self, clock: Clock) -> None:
        self.signal = Signal()
        self.cause: Cause | None = None
        self.reason = ""
        self.time_s = 0.0
        self._clock = clock
        self._heard: list[Callable[[], None]] = []

    def on_set(self, action: Callable[[], None]) -> None:
        """Call `action` when halted, before anything else goes on."""
        self._heard.append(action)

    def set(self, cause: Cause, reason: str) -> bool:
        """End the test; False if it was already ending."""
        if self.cause is not None:
            return False
        self.cause, self.reason, self.time_s = cause, reason, self._clock.now_s()
        self.signal.set()
        for action in self._heard:
            action()
        return True

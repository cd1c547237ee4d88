"""The only way to end a test early: the first reason counts, and wakes the sender at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from stimrig.rig.clock import Clock
from stimrig.rig.tasks import Signal

Cause = Literal["stopped", "fault", "withdrawn"]
"""`withdrawn`: nothing is wrong, so nothing latches. A stop or a fault that comes later outranks it."""


class Halt:
    """Set once, or once more after a withdrawal; `signal` wakes all who wait."""

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
        if self.cause not in (None, "withdrawn") or cause == self.cause:
            return False
        self.time_s = self._clock.now_s() if self.cause is None else self.time_s
        self.cause, self.reason = cause, reason
        self.signal.set()
        for action in self._heard:
            action()
        return True

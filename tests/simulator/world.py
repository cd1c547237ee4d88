"""The world of one life: one clock, one source of chance, and the trace of what happened."""

from __future__ import annotations

import hashlib
import heapq
import random
from collections.abc import Callable
from itertools import count


class World:
    """True time in seconds, from 0; events in the order of their time, those of one moment in the order they were made.

    `seed`: of every chance in this life.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.now_s = 0.0
        self.chance = random.Random(seed)
        self.trace: list[str] = []
        self.faults = 0
        """How many were injected."""
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()

    def at(self, time_s: float, action: Callable[[], None]) -> None:
        """Do something at a time, or next if it has passed."""
        heapq.heappush(self._events, (max(time_s, self.now_s), next(self._order), action))

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do something after a delay."""
        self.at(self.now_s + delay_s, action)

    def run(self, until_s: float) -> None:
        """Let time pass until `until_s`."""
        while self._events and self._events[0][0] <= until_s:
            time_s, _, action = heapq.heappop(self._events)
            self.now_s = time_s
            action()
        self.now_s = until_s

    def tell(self, edge: str, what: str, time_s: float | None = None) -> None:
        """One line of the trace: time, edge, what."""
        self.trace.append(f"{self.now_s if time_s is None else time_s:11.6f} {edge:9} {what}")

    def digest(self) -> str:
        """SHA-256 of the trace."""
        return hashlib.sha256("\n".join(self.trace).encode()).hexdigest()

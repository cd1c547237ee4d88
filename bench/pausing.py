"""Takes a rig's computer away while a bench plays on it: its processes stand still, or busy ones run beside them."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.harness.pauses import Guardian, below, pattern
from tests.harness.processes import busy_process

WAYS = ("idle", "host", "machine", "load")
"""Nothing; rig and service with their workers, all or one of them; all and the emulator; two busy processes a core."""


@dataclass(frozen=True)
class Taken:
    """What is taken away: in which way, which share of the time, and the bounds of a pause, s."""

    way: str
    share: float = 0.1
    shortest_s: float = 0.02
    longest_s: float = 0.8


@dataclass(frozen=True)
class Stood:
    """A pause as it was, monotonic, s; and whether the rig's process stood still in it."""

    began_s: float
    ended_s: float
    rig: bool


class Disturber:
    """Takes time away from the processes of a rig, from `begin` on to the end of its context.

    Parameters
    ----------
    running : the services whose processes stand still.
    seed : of the pattern of pauses.
    rigs : so many rigs share the busy processes.
    """

    def __init__(self, running: Any, seed: int, taken: Taken, rigs: int = 1) -> None:
        self.running, self.seed, self.taken, self.rigs = running, seed, taken, rigs
        self.stood: list[Stood] = []
        self._begun, self._ended = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Disturber:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._begun.set()
        self._thread.join()

    def begin(self) -> None:
        """The first gap begins."""
        self._begun.set()

    def _run(self) -> None:
        self._begun.wait()
        if self.taken.way == "load":
            with ExitStack() as stack:
                for _ in range(-(-2 * (os.cpu_count() or 1) // self.rigs)):
                    stack.enter_context(busy_process())
                self._ended.wait()
        elif self.taken.way != "idle":
            guardian = Guardian(Path(tempfile.mkdtemp(prefix="paused-")))
            try:
                self._pause_until_the_end(guardian)
            finally:
                guardian.close()

    def _pause_until_the_end(self, guardian: Guardian) -> None:
        rig, taken = self.running.rig.process.pid, self.taken
        for pause in pattern(self.seed, taken.share, taken.shortest_s, taken.longest_s):
            if self._ended.wait(pause.after_s):
                return
            host = self._host()
            chosen = pause.of(host) if taken.way == "host" else [self.running.emulator.process.pid, *host]
            began_s = time.monotonic()
            try:
                guardian.stop(chosen)
                self._ended.wait(pause.duration_s)
            finally:
                guardian.resume()
            self.stood.append(Stood(began_s, time.monotonic(), rig in chosen))

    def _host(self) -> list[int]:
        """Rig and service with their workers."""
        roots = [child.process.pid for child in (self.running.rig, self.running.api)]
        return [pid for root in roots for pid in (root, *below(root))]

"""The outlets of Lab Streaming Layer beside the service: wanted or not, they never keep it from starting or running."""

from __future__ import annotations

import time

from stimrig.api.cli.child import Child

AGAIN_S = (1.0, 5.0, 30.0)
"""Real seconds until they are started again; the last one for every further time."""
LASTED_S = 300.0


class Streams:
    """Starts `stimrig.rig.lsl_outlets`, and again when it dies; waits for nothing.

    Parameters
    ----------
    child
        How it is started.
    """

    def __init__(self, child: Child) -> None:
        self.child = child
        self._deaths = 0
        self._again_s: float | None = None
        self._given_up = False

    def start(self, source: list[str], data: str) -> None:
        """Start the process; what goes wrong is told by `watch`."""
        self.child.command += [*source, "--data", data]
        self._spawn()

    def watch(self) -> list[str]:
        """Start it again if it died; what happened, in words."""
        now_s = time.monotonic()
        if self._given_up or self.child.alive():
            return []
        if self._again_s is None:
            return [self._told(now_s)]
        if now_s < self._again_s:
            return []
        self._spawn()
        return []

    def _told(self, now_s: float) -> str:
        if now_s - self.child.started_s > LASTED_S:
            self._deaths = 0
        process = self.child.process
        words = (self.child.last_words() if process is not None else "it could not be started").removeprefix("lsl: ")
        if process is not None and process.poll() == 2:  # it says what is missing; it would say it again and again
            self._given_up = True
            return f"lsl: {words}; nothing is streamed, all else goes on"
        self._again_s = now_s + AGAIN_S[min(self._deaths, len(AGAIN_S) - 1)]
        self._deaths += 1
        return f"lsl had ended ({words or 'without a message'}) and is started again; all else goes on"

    def _spawn(self) -> None:
        self._again_s = None
        self.child.end()
        self.child.process = None
        self.child.start_unheard()

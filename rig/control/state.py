"""State of the rig with its reason, the rules for changing it, and the part that the next process needs."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import AsyncIterator, Callable

from stimrig.rig.control.calibration import Calibration
from stimrig.rig.control.memory import LatchFile
from stimrig.rig.errors import BusyError, LatchChangedError, RigError
from stimrig.rig.phase import STOPPED, Phase
from stimrig.rig.tasks import Task, Tasks, Turn

log = logging.getLogger("rig")

MAX_REQUEST_S = 60.0
"""Real seconds that a request may take: re-arming reopens both devices and seals journals that were left."""
RETRY_S = 1.0
"""Real seconds between two attempts to write a latch that the disk refused."""


class State:
    """The phase, its latch and the turn of requests.

    Requests that begin something take their turn, one after the other. A stop never waits for it: it changes the state
    at once, and what was begun finds that out before it goes on.

    `instance`: of this process, another one for each; `publish`: called after each change.
    """

    def __init__(self, file: LatchFile, tasks: Tasks, instance: str, publish: Callable[[], None]) -> None:
        self.phase = Phase()
        self.file = file
        self.calibration: Calibration | None = None
        """The one that is open: a stop, a fault or a lost device closes it."""
        self.closing = False
        """True once the rig shuts down: from then on nothing begins."""
        self._tasks, self._clock, self._publish = tasks, tasks.clock, publish
        self._turn = Turn(tasks)
        self._turn_since_s: float | None = None
        self._instance, self._stops = instance, 0
        """Count of stops, of reported faults, and of changes of the reason for a stop."""
        self._published = ""
        """The latch that was told last."""
        self._latching: Task[None] | None = None
        """Writes the latch of the last stop."""

    @property
    def latch(self) -> str:
        """Version of the latch that a person who re-arms must have seen: new after each stop, and in each process."""
        return f"{self._instance}-{self._stops}"

    @contextlib.asynccontextmanager
    async def in_turn(self) -> AsyncIterator[None]:
        """For requests that begin something: one after the other. Raises BusyError once the rig shuts down."""
        async with self._turn:
            if self.closing:
                raise BusyError("the rig is shutting down")
            self._turn_since_s = self._clock.now_s()
            try:
                yield
            finally:
                self._turn_since_s = None

    def trouble(self) -> str | None:
        """That a request hangs; None: none does."""
        running_s = 0.0 if self._turn_since_s is None else (self._clock.now_s() - self._turn_since_s)
        if running_s > MAX_REQUEST_S * self._clock.speed:
            return f"a request has been running for {running_s / self._clock.speed:.0f} s"
        return None

    def refuse_unseen(self, latch: str) -> None:
        """Raise LatchChangedError if the rig was stopped since `latch` was told: who asks has not seen it."""
        if latch == self.latch:
            return
        if self.phase.reason_stopped:
            raise LatchChangedError(
                f"now: {self.phase.reason_stopped}; look at the participant and the rig, then re-arm"
            )
        raise LatchChangedError("the rig was stopped while this waited; look at the participant, then ask again")

    def change(self, phase: Phase) -> None:
        if phase.reason_stopped not in ("", self.phase.reason_stopped):
            self._stops += 1
        changed = phase != self.phase or self._published != self.latch
        self.phase, self._published = phase, self.latch
        if not phase.calibrating:
            self.calibration = None
        if changed:
            # not the reason: it may name a person; of a fault it was logged
            log.info("state %s", phase.state, extra={"test_id": phase.test_id})
            self._publish()

    def count_stop(self) -> None:
        """Somebody or something asked for a stop: whoever re-arms must have seen it."""
        self._stops += 1

    def halted(self, reason: str, phase: Phase | None = None) -> None:
        """A stop or a fault: the state that follows (on `phase`, or on the present one), and its latch for the next
        process."""
        following = (phase or self.phase).halted(reason)
        if following.state in STOPPED or following.state == "sealing":
            # behind whatever is being written: a clear that was under way does not come last
            self._latching = self._tasks.spawn(self.remember(following), "latch file")
        self.change(following)

    async def remember(self, phase: Phase) -> None:
        """Write the latch file. If the disk fails, the rig stays stopped; a latch is written once the disk takes it.

        Until then the file holds "running" if a test had begun, so that the next process starts as uncertain.
        """
        try:
            await self.file.write("running" if phase.state == "uncertain" else "latched", phase.reason)
        except RigError as error:
            log.error("%s", error)
            self._tasks.spawn(self._remember_later(), "latch file")

    async def _remember_later(self) -> None:
        await self._tasks.sleep(RETRY_S)
        async with self._turn:  # not while somebody re-arms
            if self.phase.state in STOPPED:
                await self.remember(self.phase)

    async def settle(self) -> None:
        """Store what the rig will be after this test; once more if it is stopped meanwhile."""
        stored = None
        while stored is not self.phase:
            stored = self.phase
            following = stored.sealed()
            if following.state == "latched":
                await self.remember(following)
            else:
                await self.file.clear()

    async def written(self, until_s: float = math.inf) -> None:
        """Wait until what the next process has to know of the last stop is stored, or the disk refused it, or hangs."""
        if self._latching is not None:
            await self._tasks.wait(until_s, self._latching.done)

"""Watches a test in which a joint moves: what was seen of angle and velocity, and when that is enough."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.sessions.coverage import Coverage
from stimrig.api.sessions.joint_plan import PASSIVE
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.sessions.samples import samples_of
from stimrig.rig.messages import EnoughRequest, LiveEvent, TestPlan

log = logging.getLogger("stimrig.joint")

SETTLED_S = 0.5
"""After stimulation has begun: then the torque is that of the level."""
TELL_S = 0.2
"""Pages hear this often how much was seen."""
SERVICE = "stimrig"
"""Who says enough where enough was seen."""


@dataclass
class Watched:
    """What is known of the test, for pages and for its document."""

    coverage: Coverage
    state: str = "watching"
    """watching; alone: nobody counts any more, `problem` says why; ending."""
    problem: str = ""
    ended: str = ""
    angle_rad: float | None = None
    velocity_rad_s: float | None = None
    torque_time_nm_s: float = 0.0


class Watcher:
    """One test from its first sample to its end.

    Parameters
    ----------
    plan : TestPlan
        As the rig plays it.
    coverage : Coverage
        Of nothing yet.
    tell : callable
        Called whenever there is something new for pages.
    """

    def __init__(
        self, plan: TestPlan, coverage: Coverage, rig: RigClient, clock: Clock, tell: Callable[[], None]
    ) -> None:  # fmt: skip
        self.plan, self.rig, self.clock, self.tell = plan, rig, clock, tell
        self.told = Watched(coverage)
        self._since_s: float | None = None
        self._told_s = -TELL_S
        self._asking: asyncio.Task[None] | None = None

    async def run(self, path: Path | None) -> None:
        """Watch it to its end."""
        try:
            async with contextlib.aclosing(samples_of(path, self.plan.test_id)) as events:
                async for event in events:
                    self.hear(event)
        except ApiError as error:
            self._leave_alone(f"{error.title}. {error.detail}")
        except Exception as error:
            log.exception("a test of a joint is not watched any more")
            self._leave_alone(f"{type(error).__name__}.")
        finally:
            if self._asking is not None:
                self._asking.cancel()
                await asyncio.gather(self._asking, return_exceptions=True)

    def _leave_alone(self, why: str) -> None:
        if self.told.state == "watching":
            self.told.state = "alone"
            self.told.problem = f"What is seen is not counted any more. The test goes on to its longest time: {why}"
            log.warning("%s", self.told.problem, extra={"test_id": self.plan.test_id})
            self.tell()

    def hear(self, event: LiveEvent) -> None:
        """Take the samples since the last event; where they are enough, have the rig end the test well."""
        told = self.told
        told.torque_time_nm_s = event.torque_time_nms
        for at_s, width_us in zip(event.pulse_time_s, event.pulse_width_us, strict=True):
            if not (width_us > 0.0):
                self._since_s = None
            elif self._since_s is None:
                self._since_s = at_s
        for row in event.angle or []:
            self._take(row)
        if told.state == "watching" and told.coverage.enough and not event.ended_by:
            told.state, told.ended = "ending", "covered"
            self._asking = asyncio.create_task(self._say_enough())
        now_s = self.clock.monotonic_s()
        if now_s - self._told_s >= TELL_S or told.state == "ending":
            self._told_s = now_s
            self.tell()

    def _take(self, row: list[float | None]) -> None:
        time_s, angle_rad, velocity_rad_s = row
        if time_s is None or angle_rad is None or velocity_rad_s is None:
            return
        self.told.angle_rad, self.told.velocity_rad_s = angle_rad, velocity_rad_s
        self.told.coverage.add(time_s, angle_rad, velocity_rad_s, self._counts(time_s))

    def _counts(self, time_s: float) -> bool:
        """Without stimulation everything counts in a passive test, and nothing in another one."""
        if self.plan.kind == PASSIVE:
            return True
        return self._since_s is not None and time_s - self._since_s >= SETTLED_S

    async def _say_enough(self) -> None:
        try:
            await self.rig.ask(EnoughRequest(test_id=self.plan.test_id, by=SERVICE, at_once=True))
        except ApiError as error:  # it has ended by itself, or a person was quicker
            if error.code != "rig-late":
                self.told.state, self.told.ended = "watching", ""
                self._leave_alone(f"{error.title}. {error.detail}")

    def document(self) -> dict[str, Any]:
        """As clients see it."""
        return {**vars(self.told), "coverage": self.told.coverage.document()}

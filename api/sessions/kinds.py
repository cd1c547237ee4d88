"""Kinds of tests: how each is planned, watched while it plays, and told after it. One lifecycle serves them all."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.jobs.tasks import Tasks
from stimrig.api.models.registry import Versions
from stimrig.api.sessions.requests import TestIn
from stimrig.api.sessions.rig_client import RigClient, events_of
from stimrig.api.store.tables import Test
from stimrig.rig.messages import AnglePlan, FinishedEvent, LiveEvent, TestPlan

SERVICE = "stimrig"
"""Requester of an early end by the service."""
AT_STOPPING_TORQUE_S = 12.0
"""The largest torque-time, where nobody says: so many seconds at the torque that stops the test."""
Send = Callable[[dict[str, Any]], None]


@dataclass(frozen=True)
class Planned:
    """A plan, and what else is known of it before it is played."""

    plan: TestPlan
    extra: dict[str, Any] = field(default_factory=dict)  # stored with the plan; empty for a plain test
    how: dict[str, Any] | None = None  # arguments of the adviser, for an adaptive test


class Kind:
    """A plain test: it plays its plan, and gives a model. Other kinds are what differs from that."""

    names: tuple[str, ...] = ()
    """As requests call them."""
    part = ""
    """Name of this kind's own part in a test's document, its summary and the live messages."""
    fitted = True
    """True where a single test gives a model."""

    def __init__(self, rig: RigClient) -> None:
        self.rig = rig

    async def planned(self, body: TestIn, plan: TestPlan, preview_s: float) -> Planned:  # noqa: ARG002
        """The plan to play; with an angle, one that the joint's angle may stop, too.

        Raises ApiError: 409 the rig has no angle sensor; 422 the participant has no range of angles; what the kind or
        rig refuses.
        """
        if body.angle is not None:
            watched = AnglePlan(range_rad=self.range_of(plan), still_s=body.angle.still_s)
            plan = plan.model_copy(update={"angle": watched})
        return Planned(plan)

    def range_of(self, plan: TestPlan) -> tuple[float, float]:
        """The participant's range of angles, where the rig can watch it."""
        status = self.rig.status
        if status is not None and not status.angle.present:
            raise no_sensor()
        range_rad = plan.profile.angle_range_rad
        if range_rad is None:
            detail = f"Set the angles that are comfortable for {plan.participant}: angle_range_rad of its profile."
            raise ApiError(422, "no-angle-range", "The participant has no range of angles", detail)
        return range_rad

    def stored_fields(self, body: TestIn, pulses: int) -> dict[str, Any]:  # noqa: ARG002
        """Return further fields to store of a test with this many pulses. Raises ApiError (422): they do not match."""
        return {}

    def begin(self, planned: Planned) -> str:  # noqa: ARG002
        """Watch a test that is about to start; the key with which it is started: empty where there is nothing to."""
        return ""

    def said_enough(self, test_id: str) -> None:
        """A person has ended it well."""

    def unwatch(self) -> None:
        """Watch no test any more."""

    async def close(self) -> None:
        """Release all resources."""

    def outcome(self, row: Test, event: FinishedEvent) -> dict[str, Any]:  # noqa: ARG002
        """Return the summary fields of a test that has ended."""
        return {}

    def fit_options(self, row: Test) -> dict[str, Any]:  # noqa: ARG002
        """Return the options of the recording's fit."""
        return {}

    def document(self, row: Test) -> dict[str, Any] | None:  # noqa: ARG002
        """Return the state or the result of a test of this kind."""
        return None


class Kinds:
    """All of them, by the name of a test's kind."""

    def __init__(self, plain: Kind, *others: Kind) -> None:
        self.all = (plain, *others)
        self._by_name = {name: kind for kind in others for name in kind.names}
        self.parts = [kind.part for kind in others if kind.part]

    def __getitem__(self, name: str) -> Kind:
        return self._by_name.get(name, self.all[0])

    def documents(self, row: Test) -> dict[str, Any]:
        """Return the part of each kind's own document; null for the other kinds."""
        kind = self[row.kind]
        return dict.fromkeys(self.parts) | ({kind.part: kind.document(row)} if kind.part else {})


class Watcher:
    """A test from its first sample to its end. Whatever goes wrong in watching leaves it to its plan, status.

    `plan`: as the rig plays it. `status`: what is known of the test, for pages and its document; has `state`, `problem`
    and `ended`. `publish`: called whenever there is something new for pages.
    """

    watching_state, failed_state = "watching", "alone"
    """States while watching, and after an error."""
    log = logging.getLogger("stimrig.sessions")

    def __init__(self, plan: TestPlan, status: Any, rig: RigClient, clock: Clock, publish: Callable[[], None]) -> None:
        self.plan, self.status, self.rig, self.clock, self.publish = plan, status, rig, clock, publish
        self._tasks = Tasks(self.log)

    async def run(self, path: Path | None) -> None:
        """Watch it to its end."""
        try:
            await self._guarded(self._listen(path))
        finally:
            await self._tasks.close()

    async def _listen(self, path: Path | None) -> None:
        async with contextlib.aclosing(events_of(path, self.plan.test_id)) as events:
            async for event in events:
                self.hear(event)

    def hear(self, event: LiveEvent) -> None:
        """Take the samples since the last event."""
        raise NotImplementedError

    def begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run it in the background, so that no sample is missed."""
        return self._tasks.begin(self._guarded(work))

    async def _guarded(self, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        except ApiError as error:
            self.give_up(f"{error.title}. {error.detail}")
        except Exception as error:
            self.log.exception("a test is not watched any more")
            self.give_up(f"{type(error).__name__}.")

    def give_up(self, why: str) -> None:
        """Watch no more."""
        if self.status.state == self.watching_state:
            self.status.state, self.status.problem = self.failed_state, self.problem(why)
            self.log.warning("%s", self.status.problem, extra={"test_id": self.plan.test_id})
            self.publish()

    def problem(self, why: str) -> str:
        """Return the problem text for a test that is no longer watched."""
        raise NotImplementedError

    def document(self) -> dict[str, Any]:
        """As clients see it."""
        raise NotImplementedError


class Watched(Kind):
    """A kind whose running test this service watches, sample by sample; at most one runs.

    `send`: called with a message for the live channel.
    """

    ends: ClassVar[Mapping[str, str]] = {}
    """Reasons for the end of a test, by the rig's reason, where they have another name."""

    def __init__(self, clock: Clock, rig: RigClient, versions: Versions, send: Send) -> None:
        super().__init__(rig)
        self.clock, self.versions, self.send = clock, versions, send
        self.watcher: Watcher | None = None
        self._task: asyncio.Task[None] | None = None

    def watch(self, watcher: Watcher) -> None:
        """Watch this test."""
        self.unwatch()
        self.watcher, self._task = watcher, asyncio.create_task(watcher.run(self.rig.path))

    @property
    def watching(self) -> bool:
        """Return whether a test is being watched."""
        return self._task is not None and not self._task.done()

    def publish(self) -> None:
        """Send its state to the pages."""
        if self.watcher is not None:
            self.send({"type": self.part, "test_id": self.watcher.plan.test_id, **self.watcher.document()})

    def _watcher_of(self, test_id: str) -> Watcher | None:
        return self.watcher if self.watcher is not None and self.watcher.plan.test_id == test_id else None

    def said_enough(self, test_id: str) -> None:
        """As `Kind`."""
        if (watcher := self._watcher_of(test_id)) is not None:
            watcher.status.state, watcher.status.ended = "ending", watcher.status.ended or "enough"
            self.publish()

    def unwatch(self) -> None:
        """As `Kind`."""
        if self._task is not None:
            self._task.cancel()
        self._task, self.watcher = None, None

    async def close(self) -> None:
        """As `Kind`."""
        task = self._task
        self.unwatch()
        if task is not None:
            await asyncio.gather(task, return_exceptions=True)

    def outcome(self, row: Test, event: FinishedEvent) -> dict[str, Any]:
        """As `Kind`."""
        rigs, standing = str(event.summary.get("ended_by") or event.outcome), self._standing(row)
        ended = standing["ended"] if rigs == "enough" and standing["ended"] else self.ends.get(rigs, rigs)
        ended = self.end_of(row, event, rigs, standing) or ended
        measured = event.summary.get("torque_time_nms", standing["torque_time_nm_s"])
        return {self.part: {**standing, "torque_time_nm_s": measured, "state": "ended", "ended": ended}}

    def end_of(self, row: Test, event: FinishedEvent, rigs: str, standing: Mapping[str, Any]) -> str:  # noqa: ARG002
        """Return why it ended, where the rig's reason is not enough."""
        return ""

    def document(self, row: Test) -> dict[str, Any] | None:
        """As `Kind`."""
        return row.summary.get(self.part) or self._standing(row)

    def _standing(self, row: Test) -> dict[str, Any]:
        watcher = self._watcher_of(row.id)
        return watcher.document() if watcher is not None else self.unwatched(row)

    def unwatched(self, row: Test) -> dict[str, Any]:
        """Return the document of a test that is not watched: it never began, or the service was restarted."""
        raise NotImplementedError


def begun(row: Test) -> bool:
    """Return whether any part of a test was played."""
    return row.state not in ("requested", "refused")


def no_sensor() -> ApiError:
    """409: the rig sees no angle."""
    detail = "This rig has no angle sensor. The rig file names one under [angle_sensor]."
    return ApiError(409, "no-angle-sensor", "There is no angle sensor", detail)

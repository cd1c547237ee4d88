"""Kinds of tests: how each is planned, watched while it plays, and told after it. One lifecycle serves them all."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from dataclasses import asdict, dataclass, field
from typing import Any

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.jobs.tasks import Tasks
from stimrig.api.models.registry import Versions
from stimrig.api.sessions.requests import TestIn
from stimrig.api.sessions.rig_client import RigClient, no_rig
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
    how: dict[str, Any] = field(default_factory=dict)  # arguments of the adviser, for an adaptive test


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

    def hear(self, event: LiveEvent | None) -> None:
        """Take the newest samples of the rig; None: the connection to it broke."""

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

    def document(self, row: Test) -> dict[str, Any]:  # noqa: ARG002
        """Return the state or the result of a test of this kind."""
        return {}


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


@dataclass
class WatchStatus:
    """State of a watched test, for pages and its document."""

    state: str
    problem: str = ""
    """Why it is not watched any more."""
    ended: str = ""
    torque_time_nm_s: float | None = None


class Watched(Kind):
    """A kind whose running test this service watches, sample by sample; at most one runs.

    `send`: called with a message for the live channel.
    """

    status_type: type[WatchStatus] = WatchStatus
    watching, alone = "watching", "alone"
    """States of a test that is watched, and of one that is left to its plan."""
    left_alone = ""
    """Consequence of leaving it to its plan, in words."""

    def __init__(self, clock: Clock, rig: RigClient, versions: Versions, send: Send) -> None:
        super().__init__(rig)
        self.clock, self.versions, self.send = clock, versions, send
        self.watcher: Watcher | None = None

    def watch(self, watcher: Watcher) -> None:
        """Watch this test. Without a link to the rig it is left to its plan: the loss was reported before."""
        self.unwatch()
        self.watcher = watcher
        watcher.start()
        if not self.rig.connected:
            watcher.take(None)

    @property
    def is_watching(self) -> bool:
        """Return whether a test is being watched."""
        return self.watcher is not None and self.watcher.listens

    def hear(self, event: LiveEvent | None) -> None:
        if self.watcher is not None and (event is None or event.test_id == self.watcher.plan.test_id):
            self.watcher.take(event)

    def publish(self) -> None:
        """Send its state to the pages."""
        if self.watcher is not None:
            self.send({"type": self.part, "test_id": self.watcher.plan.test_id, **self.watcher.document()})

    def said_enough(self, test_id: str) -> None:
        if (watcher := self._watcher_of(test_id)) is not None:
            watcher.status.state, watcher.status.ended = "ending", watcher.status.ended or "enough"
            self.publish()

    def unwatch(self) -> None:
        if self.watcher is not None:
            self.watcher.tasks.cancel()
        self.watcher = None

    async def close(self) -> None:
        watcher = self.watcher
        self.unwatch()
        if watcher is not None:
            await watcher.tasks.close()

    def outcome(self, row: Test, event: FinishedEvent) -> dict[str, Any]:
        by, status = str(event.summary.get("ended_by") or event.outcome), self._status(row)
        ended = (by == "enough" and status["ended"]) or self.ended(row, event, by)
        measured = event.summary.get("torque_time_nms", status["torque_time_nm_s"])
        return {self.part: {**status, "torque_time_nm_s": measured, "state": "ended", "ended": ended}}

    def ended(self, row: Test, event: FinishedEvent, by: str) -> str:
        """Return why a test ended, by what ended it on the rig."""
        raise NotImplementedError

    def document(self, row: Test) -> dict[str, Any]:
        return row.summary.get(self.part) or self._status(row)

    def _watcher_of(self, test_id: str) -> Watcher | None:
        return self.watcher if self.watcher is not None and self.watcher.plan.test_id == test_id else None

    def _status(self, row: Test) -> dict[str, Any]:
        """A test that is not watched never began, has a fixed plan, or the service was restarted."""
        if (watcher := self._watcher_of(row.id)) is not None:
            return watcher.document()
        status = self.status_type(self.watching)
        if row.plan["adaptive"] is not None and row.state not in ("requested", "refused"):
            status.state, status.problem = self.alone, f"{self.left_alone}: the service was restarted during the test."
        return asdict(status)


class Watcher:
    """Follows one test from its first sample to its end. Whatever goes wrong in that leaves the test to its plan."""

    log = logging.getLogger("stimrig.sessions")

    def __init__(self, plan: TestPlan, kind: Watched) -> None:
        self.plan, self.kind, self.rig, self.clock = plan, kind, kind.rig, kind.clock
        self.status: Any = kind.status_type(kind.watching)
        self.tasks, self.listens = Tasks(self.log), True

    def start(self) -> None:
        """Begin what has to be done before the first sample."""

    def take(self, event: LiveEvent | None) -> None:
        """Take an event of this test; None: the connection to the rig broke, and samples are missing."""
        if not self.listens:
            return
        try:
            if event is None:
                raise no_rig("It closed the connection.")
            self.hear(event)
        except Exception as error:
            self.listens = False
            self._fail(error)

    def hear(self, event: LiveEvent) -> None:
        """Take the samples since the last event."""
        raise NotImplementedError

    def begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run it in the background, so that no sample is missed."""
        return self.tasks.begin(self._guarded(work))

    async def _guarded(self, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        expected = isinstance(error, ApiError)
        if not expected:
            self.log.error("a test is not watched any more", exc_info=error)
        self.give_up(f"{error.title}. {error.detail}" if expected else f"{type(error).__name__}.")

    def give_up(self, why: str) -> None:
        """Watch no more."""
        if self.status.state == self.kind.watching:
            self.status.state, self.status.problem = self.kind.alone, f"{self.kind.left_alone}: {why}"
            self.log.warning("%s", self.status.problem, extra={"test_id": self.plan.test_id})
            self.kind.publish()

    def document(self) -> dict[str, Any]:
        """As clients see it."""
        return asdict(self.status)


def no_sensor() -> ApiError:
    """409: the rig sees no angle."""
    detail = "This rig has no angle sensor. The rig file names one under [angle_sensor]."
    return ApiError(409, "no-angle-sensor", "There is no angle sensor", detail)

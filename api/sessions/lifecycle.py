"""What becomes of a test: its row, its recording, its model; and what is found of one whose end nobody heard."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.models.analyses import Analyses
from stimrig.api.models.registry import Versions
from stimrig.api.sessions.adaptive_tests import AdaptiveTests
from stimrig.api.sessions.following import Follower
from stimrig.api.sessions.joint_plan import KINDS
from stimrig.api.sessions.joint_tests import JointTests
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.sessions.trials import SEQUENCE
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import OPEN_STATES, Model, Recording, Test
from stimrig.api.workers.pool import Call, Pool
from stimrig.rig.messages import FinishedEvent

log = logging.getLogger("stimrig.outcomes")
NOT_FITTED = (SEQUENCE, *KINDS)
"""Kinds of tests that give no model by themselves: a trial is followed, a guided test is fitted with others."""


class LeftError(Exception):
    """Another service follows the test now: this one was thought dead."""


class Lifecycle:
    """Takes over what a test leaves behind.

    Parameters
    ----------
    on_progress : callable
        Called with a test's id whenever its identification has got further.
    """

    def __init__(
        self, store: Store, clock: Clock, rig: RigClient, pool: Pool, versions: Versions,
        analyses: Analyses, adaptive: AdaptiveTests, joint: JointTests, recordings_dir: Path, follower: Follower,
        on_progress: Callable[[str], None],
    ) -> None:  # fmt: skip
        self.store, self.clock, self.rig, self.pool, self.versions = store, clock, rig, pool, versions
        self.analyses, self.recordings_dir, self.on_progress = analyses, recordings_dir, on_progress
        self.adaptive, self.joint, self.follower = adaptive, joint, follower
        self.calls: dict[str, Call] = {}
        self._ahead: set[asyncio.Task[None]] = set()

    def update(self, test_id: str, **fields: Any) -> Test:
        """Change a test's row."""
        with self.store.write() as session:
            row = session.get(Test, test_id)
            assert row is not None
            if fields.get("state") == "running" and row.state != "requested":
                fields.pop("state")  # the rig was done before we wrote that it had begun
            for name, value in fields.items():
                setattr(row, name, value)
            if row.state not in OPEN_STATES and row.finished_utc is None:
                row.finished_utc = self.clock.utc()
        if "state" in fields:
            log.info("test %s", row.state, extra={"test_id": test_id})
        return row

    def fail(self, test_id: str, error: Exception) -> None:
        """End a test that is still open: something unexpected went wrong with it."""
        row = self.store.get(Test, test_id)
        if row is not None and row.state in OPEN_STATES:
            self.update(test_id, state="failed", reason=" ".join(str(error).split()) or type(error).__name__)

    def take_recording(self, event: FinishedEvent) -> Test | None:
        """Write down how a test ended and where its recording lies; None where that is done, or another service's."""
        with self.store.write() as session:
            row = session.get(Test, event.test_id)
            if row is None or row.recording_id is not None or not self.follower.mine(row):
                return None
            if event.recording_path and event.recording_id:
                recording = self._recording(row, event)
                session.add(recording)
                session.flush()
                row.recording_id = event.recording_id
            identifies = event.outcome == "completed" and row.recording_id is not None and row.kind not in NOT_FITTED
            row.state = "identifying" if identifies else event.outcome
            row.reason = event.reason
            row.summary = {**event.summary, **self.adaptive.outcome(row, event), **self.joint.outcome(row, event)}
            row.finished_utc = now = self.clock.utc()
            audit.write(session, now, "rig", f"test {event.outcome}", row.id, reason=event.reason)
        log.info("the rig: test %s", event.outcome, extra={"test_id": row.id})
        return row

    def _recording(self, row: Test, event: FinishedEvent) -> Recording:
        return Recording(
            id=event.recording_id,
            participant=row.participant,
            test_id=row.id,
            path=event.recording_path,
            file_sha256=event.file_sha256 or "",
            origin="rig",
            created_utc=self.clock.utc(),
        )

    async def identify(self, test_id: str, last_sample_unix_s: float | None = None) -> None:
        """Identify a test's recording in a worker and store the model."""
        row: Test = await asyncio.to_thread(self.store.get, Test, test_id)
        parent = None
        try:
            recording, parent = await self._record_of(row)
        except ApiError as error:
            reason = f"joining the recordings: {error.detail or error.title}"
            await asyncio.to_thread(self.update, test_id, state="failed", reason=reason)
            return

        def take(call: Call) -> None:
            self.calls[test_id] = call

        how: dict[str, Any] = {"urgent": True, "on_progress": lambda _job: self.on_progress(test_id)}
        try:
            model = await self._first_version(row, recording, parent, take, dict(how))
            model = await self.analyses.carried_structure.carry(model, recording.path, take, **how)
        except LeftError:
            log.warning("left to the service that took it up", extra={"test_id": test_id})
            return
        except ApiError as error:
            reason = f"identification: {error.detail or error.title}"
            await asyncio.to_thread(self.update, test_id, state="failed", reason=reason)
            return
        finally:
            self.calls.pop(test_id, None)
        summary = dict((await asyncio.to_thread(self.store.get, Test, test_id)).summary)
        if last_sample_unix_s is not None:
            summary["last_sample_to_model_s"] = round(self.clock.unix_s() - last_sample_unix_s, 3)
        await asyncio.to_thread(self.update, test_id, state="completed", model_id=model.id, summary=summary)
        ahead = asyncio.create_task(self.analyses.diagnose_ahead(model))
        self._ahead.add(ahead)
        ahead.add_done_callback(self._ahead.discard)

    async def _first_version(
        self, row: Test, recording: Recording, parent: str | None, take: Callable[[Call], None], how: dict[str, Any]
    ) -> Model:
        """The first version of a test's recording, named by the test at once: it is there whatever comes after it."""
        if row.model_id is not None:
            return await asyncio.to_thread(self.versions.get, row.model_id)
        how |= await asyncio.to_thread(self.adaptive.fit_options, row)
        found, warning = await self.analyses.carried_structure.fit(row.participant, recording.path, take, **how)
        if not self.follower.mine(await asyncio.to_thread(self.store.get, Test, row.id)):
            raise LeftError  # one recording, one model
        by = f"test {row.id}"
        model = await asyncio.to_thread(self.versions.add, found["json"], row.participant, recording.id, by, parent)
        summary = dict(row.summary)
        if warning:
            summary["warnings"] = [*(summary.get("warnings") or []), warning]
        await asyncio.to_thread(self.update, row.id, model_id=model.id, summary=summary)
        return model

    def keep_plain(self, test_id: str) -> bool:
        """End the fit of the last session's structure after a test; whether one was under way."""
        call = self.calls.get(test_id)
        if call is None or call.verb != "carry":
            return False
        self.pool.cancel(call)
        return True

    async def _record_of(self, row: Test) -> tuple[Recording, str | None]:
        """What is identified: the test's recording, or that joined to the one of the model it was made to judge."""
        if row.model_id is not None:  # the service was restarted after its first version
            first = await asyncio.to_thread(self.versions.get, row.model_id)
            return await asyncio.to_thread(self.store.get, Recording, first.recording_id), first.parent_id
        recording: Recording = await asyncio.to_thread(self.store.get, Recording, row.recording_id)
        joins = row.plan.get("joins")
        if joins is None:
            return recording, None
        model = await asyncio.to_thread(self.versions.get, joins)
        return await self.analyses.join([model.recording_id, recording.id], row.participant), model.id

    def warnings(self, recording_id: str) -> list[str]:
        """What was found doubtful about a recording, in sentences: by the rig, or when its first model was made."""
        recording = self.store.get(Recording, recording_id)
        row = self.store.get(Test, recording.test_id) if recording is not None and recording.test_id else None
        found = row.summary.get("warnings") if row is not None else recording and recording.warnings
        return list(found or [])

    async def missed_end(self, test_id: str, why: str) -> FinishedEvent:
        """The end of a test as the rig remembers it, or as its recording tells."""
        status = self.rig.status
        if status is not None and status.finished is not None and status.finished.test_id == test_id:
            return status.finished
        found = await self._find_recording(test_id)
        event = FinishedEvent(test_id=test_id, outcome="fault", reason=why, last_sample_unix_s=None)
        return event.model_copy(update=found)

    async def _find_recording(self, test_id: str) -> dict[str, Any]:
        call = self.pool.submit("find_recording", urgent=True, folder=str(self.recordings_dir), test_id=test_id)
        try:
            return (await call.result).get("found") or {}
        except ApiError as error:
            log.warning("looking for the recording of %s: %s", test_id, error)
            return {}

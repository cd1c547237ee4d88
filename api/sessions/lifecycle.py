"""Lifecycle of a test: its row, recording and model; recovers a test whose end was missed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.jobs.job import Job
from stimrig.api.jobs.pool import Pool
from stimrig.api.jobs.tasks import Tasks
from stimrig.api.models import carried_structure, together
from stimrig.api.models.analyses import Analyses
from stimrig.api.models.registry import Versions
from stimrig.api.sessions.kinds import Kinds
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import OPEN_STATES, Model, Recording, Test
from stimrig.rig.messages import LABEL_TITLES, FinishedEvent

log = logging.getLogger("stimrig.outcomes")
NOT_SHOWN = ("plan", "summary", "version")
"""Columns of a test that clients do not see as they are."""


class Lifecycle:
    """Takes over what a test leaves behind.

    `on_progress`: called with a test's id whenever its identification has got further.
    """

    def __init__(
        self, store: Store, clock: Clock, rig: RigClient, pool: Pool, versions: Versions,
        analyses: Analyses, kinds: Kinds, recordings_dir: Path,
        on_progress: Callable[[str], None],
    ) -> None:  # fmt: skip
        self.store, self.clock, self.rig, self.pool, self.versions = store, clock, rig, pool, versions
        self.analyses, self.recordings_dir, self.on_progress = analyses, recordings_dir, on_progress
        self.kinds = kinds
        self.jobs: dict[str, Job] = {}
        self._tasks = Tasks(log)

    def document(
        self, row: Test, position: tuple[float, float, str | None] | None, fits: Mapping[str, Any] | None = None
    ) -> dict[str, Any]:
        """A test as clients see it: what became of it so far; while it runs also where it is, as the rig tells it.

        `fits`: documents of models by their ids, where many tests are told of at once.
        """
        planned = {key: value for key, value in row.plan.get("preview", {}).items() if key != "pulse_width_us"}
        running = row.state in ("requested", "running")
        lasted_s = row.summary.get("duration_s", 0.0)
        there = (position or (0.0, planned.get("duration_s", 0.0), None)) if running else (lasted_s, lasted_s, None)
        elapsed_s, duration_s, segment = there
        job, rig = self.jobs.get(row.id), self.rig.status
        sealing = running and rig is not None and rig.test_id == row.id and rig.state == "sealing"
        if fits is None and row.model_id:
            fits = {row.model_id: self.versions.document(self.versions.get(row.model_id))}
        return {
            **{name: value for name, value in row.as_dict().items() if name not in NOT_SHOWN},
            "state": "sealing" if sealing else row.state,
            "done": row.state not in OPEN_STATES,
            "segment": segment,
            "elapsed_s": elapsed_s,
            "duration_s": duration_s,
            "time_left_s": max(0.0, duration_s - elapsed_s),
            "progress": min(1.0, elapsed_s / duration_s) if duration_s else 0.0,
            "identification": {"verb": job.kind, **job.progress_document()} if job else None,
            "ran_by": row.ran_by or row.requested_by,
            **{name: row.plan.get(name) for name in ("side", "muscle", "joins", *LABEL_TITLES)},
            "planned": planned,
            "recording_url": f"/v1/recordings/{row.recording_id}" if row.recording_id else None,
            "model_url": f"/v1/models/{row.model_id}" if row.model_id else None,
            "summary": {name: value for name, value in row.summary.items() if name not in self.kinds.parts},
            **self.kinds.documents(row),
            "fit": (fits or {}).get(row.model_id or ""),
        }

    def update(self, test_id: str, **fields: Any) -> Test:
        """Change a test's row."""
        with self.store.write() as session:
            row = session.get(Test, test_id)
            assert row is not None
            if fields.get("state") == "running" and row.state != "requested":
                fields.pop("state")  # the test ended before its start was written
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
        """Write down how a test ended and where its recording lies; None where that is done."""
        with self.store.write() as session:
            row = session.get(Test, event.test_id)
            if row is None or row.recording_id is not None:
                return None
            if event.recording_path and event.recording_id:
                session.add(
                    Recording(
                        id=event.recording_id, participant=row.participant, test_id=row.id, path=event.recording_path,
                        file_sha256=event.file_sha256 or "", origin="rig", created_utc=self.clock.utc(),
                    )
                )  # fmt: skip
                session.flush()
                row.recording_id = event.recording_id
            kind = self.kinds[row.kind]
            identifies = event.outcome == "completed" and row.recording_id is not None and kind.fitted
            row.state = "identifying" if identifies else event.outcome
            row.reason = event.reason
            row.summary = {**event.summary, **kind.outcome(row, event)}
            row.finished_utc = now = self.clock.utc()
            audit.write(session, now, "rig", f"test {event.outcome}", row.id, reason=event.reason)
        log.info("the rig: test %s", event.outcome, extra={"test_id": row.id})
        return row

    async def identify(self, test_id: str, last_sample_unix_s: float | None = None) -> None:
        """Identify a test's recording in a worker and store the model."""
        row: Test = await asyncio.to_thread(self.store.get, Test, test_id)

        def follow(job: Job) -> None:
            self.jobs[test_id] = job

        how: dict[str, Any] = {"urgent": True, "on_progress": lambda _job: self.on_progress(test_id)}
        step = "joining the recordings"
        try:
            recording, parent = await self._record_of(row)
            step = "identification"
            model = await self._first_version(row, recording, parent, follow, dict(how))
            model = await carried_structure.carry(self.analyses, model, recording.path, follow, **how)
        except ApiError as error:
            reason = f"{step}: {error.detail or error.title}"
            await asyncio.to_thread(self.update, test_id, state="failed", reason=reason)
            return
        finally:
            self.jobs.pop(test_id, None)
        summary = dict((await asyncio.to_thread(self.store.get, Test, test_id)).summary)
        if last_sample_unix_s is not None:
            summary["last_sample_to_model_s"] = round(self.clock.unix_s() - last_sample_unix_s, 3)
        await asyncio.to_thread(self.update, test_id, state="completed", model_id=model.id, summary=summary)
        self._tasks.begin(self.analyses.diagnose_ahead(model))

    async def _first_version(
        self, row: Test, recording: Recording, parent: str | None, follow: Callable[[Job], None], how: dict[str, Any]
    ) -> Model:
        """The first version of a test's recording, named by the test at once: it is there whatever comes after it."""
        if row.model_id is not None:
            return await asyncio.to_thread(self.versions.get, row.model_id)
        how |= await asyncio.to_thread(self.kinds[row.kind].fit_options, row)
        fit, warning = await carried_structure.fit(self.analyses, row.participant, recording.path, follow, **how)
        by = f"test {row.id}"
        model = await asyncio.to_thread(self.versions.add, fit["json"], row.participant, recording.id, by, parent)
        summary = dict(row.summary)
        if warning:
            summary["warnings"] = [*(summary.get("warnings") or []), warning]
        await asyncio.to_thread(self.update, row.id, model_id=model.id, summary=summary)
        return model

    def keep_plain(self, test_id: str) -> bool:
        """End the fit of the last session's structure after a test; whether one was under way."""
        job = self.jobs.get(test_id)
        if job is None or job.kind != "carry":
            return False
        self.pool.cancel(job)
        return True

    async def _record_of(self, row: Test) -> tuple[Recording, str | None]:
        """Return the recording to identify: the test's, or the one joined to the recording of the model under test."""
        if row.model_id is not None:  # the service was restarted after its first version
            first = await asyncio.to_thread(self.versions.get, row.model_id)
            return await asyncio.to_thread(self.store.get, Recording, first.recording_id), first.parent_id
        recording: Recording = await asyncio.to_thread(self.store.get, Recording, row.recording_id)
        joins = row.plan.get("joins")
        if joins is None:
            return recording, None
        model = await asyncio.to_thread(self.versions.get, joins)
        return await together.join(self.analyses, [model.recording_id, recording.id], row.participant), model.id

    def warnings(self, recording_id: str) -> list[str]:
        """Return the warnings about a recording, from the rig or from the fit of its first model."""
        with self.store.read() as session:
            return together.warnings(session, recording_id)

    async def missed_end(self, test_id: str, why: str) -> FinishedEvent:
        """The end of a test as the rig remembers it, or as its recording tells."""
        status = self.rig.status
        if status is not None and status.finished is not None and status.finished.test_id == test_id:
            return status.finished
        event = FinishedEvent(test_id=test_id, outcome="fault", reason=why, last_sample_unix_s=None)
        job = self.pool.submit("find_recording", urgent=True, folder=str(self.recordings_dir), test_id=test_id)
        try:
            return event.model_copy(update=(await job.result).get("found") or {})
        except ApiError as error:
            log.warning("looking for the recording of %s: %s", test_id, error)
            return event

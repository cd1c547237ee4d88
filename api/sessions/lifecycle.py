"""Lifecycle of a test: its row, its recording, its model and its document; recovers a test whose end was missed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.jobs.job import Job
from stimrig.api.jobs.tasks import Tasks
from stimrig.api.models import carried_structure, together
from stimrig.api.models.analyses import Analyses
from stimrig.api.sessions.kinds import Kinds
from stimrig.api.sessions.live import Hub
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store import audit
from stimrig.api.store.tables import OPEN_STATES, Model, Recording, Test
from stimrig.rig.messages import LABEL_TITLES, FinishedEvent

log = logging.getLogger("stimrig.outcomes")
HIDDEN = ("plan", "summary")
"""Columns of a test that clients do not see as they are."""


class Lifecycle:
    """Stores what a test leaves behind, has it identified, and tells clients and open pages how it stands."""

    def __init__(self, analyses: Analyses, rig: RigClient, kinds: Kinds, hub: Hub) -> None:
        self.analyses, self.rig, self.kinds, self.hub = analyses, rig, kinds, hub
        self.store, self.clock, self.versions = analyses.store, analyses.clock, analyses.versions
        self.jobs: dict[str, Job] = {}
        self._reader = ThreadPoolExecutor(1, "documents-of-tests")  # one thread: documents are read in call order
        self._tasks = Tasks(log)

    # ---- documents -------------------------------------------------------------------------------------------

    def document(self, row: Test, fits: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Return a test as clients see it. `fits`: documents of models by id, where many tests are read at once."""
        planned = {key: value for key, value in row.plan.get("preview", {}).items() if key != "pulse_width_us"}
        job, rig = self.jobs.get(row.id), self.rig.status
        state, segment = row.state, None
        elapsed_s = duration_s = row.summary.get("duration_s", 0.0)
        if state in ("requested", "running"):
            start = (0.0, planned.get("duration_s", 0.0), None)
            elapsed_s, duration_s, segment = self.hub.position(row.id) or start
            if rig is not None and rig.test_id == row.id and rig.state == "sealing":
                state = "sealing"
        if fits is None:
            fits = {row.model_id: self.versions.document(self.versions.get(row.model_id))} if row.model_id else {}
        return {
            **{name: value for name, value in row.as_dict().items() if name not in HIDDEN},
            "state": state,
            "done": state not in OPEN_STATES,
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
            "fit": fits.get(row.model_id or ""),
        }

    def documents(
        self, participant: str, models: list[dict[str, Any]], limit: int | None = None
    ) -> list[dict[str, Any]]:
        """Return a participant's tests, newest first. `models`: documents of all of the participant's models."""
        fits, of_participant = {model["id"]: model for model in models}, Test.participant == participant
        rows = self.store.all(Test, of_participant, order=Test.requested_utc.desc(), limit=limit)
        return [self.document(row, fits) for row in rows]

    def announce(self, test_id: str) -> None:
        """Publish how a test stands to open pages."""
        self._tasks.begin(self._announce(test_id))

    async def _announce(self, test_id: str) -> None:
        def read() -> dict[str, Any] | None:
            row = self.store.get(Test, test_id)
            return None if row is None else self.document(row)

        document = await asyncio.get_running_loop().run_in_executor(self._reader, read)
        if document is not None:
            self.hub.send({"type": "test", "test": document})

    # ---- the row -----------------------------------------------------------------------------------------------

    def update(self, test_id: str, *, summary: Mapping[str, Any] | None = None, **fields: Any) -> Test:
        """Change fields of a test's row; `summary` is added to the one that it has."""
        with self.store.write() as session:
            row = session.get(Test, test_id)
            assert row is not None
            if fields.get("state") == "running" and row.state != "requested":
                fields.pop("state")  # the test ended before its start was written
            for name, value in fields.items():
                setattr(row, name, value)
            row.summary = {**row.summary, **(summary or {})}
            if row.state not in OPEN_STATES and row.finished_utc is None:
                row.finished_utc = self.clock.utc()
        if "state" in fields:
            log.info("test %s", row.state, extra={"test_id": test_id})
        return row

    def fail(self, test_id: str, error: Exception) -> None:
        """End a test that is still open, for an unexpected error."""
        row = self.store.get(Test, test_id)
        if row is not None and row.state in OPEN_STATES:
            self.update(test_id, state="failed", reason=" ".join(str(error).split()) or type(error).__name__)

    def take_recording(self, event: FinishedEvent) -> Test | None:
        """Store how a test ended and where its recording is; None where that is done."""
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

    def warnings(self, recording_id: str) -> list[str]:
        """Return the warnings about a recording, from the rig or from its upload."""
        with self.store.read() as session:
            return together.warnings(session, recording_id)

    async def missed_end(self, test_id: str, why: str) -> FinishedEvent:
        """Return the end of a test as the rig remembers it, or as its recording says."""
        status = self.rig.status
        if status is not None and status.finished is not None and status.finished.test_id == test_id:
            return status.finished
        event = FinishedEvent(test_id=test_id, outcome="fault", reason=why, last_sample_unix_s=None)
        folder = str(self.analyses.settings.recordings_dir)
        try:
            answer = await self.analyses.run("find_recording", urgent=True, folder=folder, test_id=test_id)
            return event.model_copy(update=answer.get("found") or {})
        except ApiError as error:
            log.warning("looking for the recording of %s: %s", test_id, error)
            return event

    # ---- identification ----------------------------------------------------------------------------------------

    async def identify(self, test_id: str, last_sample_unix_s: float | None = None) -> None:
        """Identify a test's recording in a worker and store the model."""
        row: Test = await asyncio.to_thread(self.store.get, Test, test_id)

        def follow(job: Job) -> None:
            self.jobs[test_id] = job

        how: dict[str, Any] = {"urgent": True, "on_progress": lambda _job: self.announce(test_id)}
        step = "joining the recordings"
        try:
            recording, parent = await self._recording_of(row)
            step = "identification"
            model = await self._first_version(row, recording, parent, follow, how)
            model = await carried_structure.carry(self.analyses, model, recording.path, follow, **how)
        except ApiError as error:
            reason = f"{step}: {error.detail or error.title}"
            await asyncio.to_thread(self.update, test_id, state="failed", reason=reason)
            return
        finally:
            self.jobs.pop(test_id, None)
        late_s = None if last_sample_unix_s is None else round(self.clock.unix_s() - last_sample_unix_s, 3)
        summary = {} if late_s is None else {"last_sample_to_model_s": late_s}
        await asyncio.to_thread(self.update, test_id, state="completed", model_id=model.id, summary=summary)

    async def _recording_of(self, row: Test) -> tuple[Recording, str | None]:
        """Return the recording to identify, the test's or a joined one, and the model that it is joined to."""
        if row.model_id is not None:  # the service was restarted after its first version
            first = await asyncio.to_thread(self.versions.get, row.model_id)
            return await asyncio.to_thread(self.store.get, Recording, first.recording_id), first.parent_id
        recording: Recording = await asyncio.to_thread(self.store.get, Recording, row.recording_id)
        if (joins := row.plan.get("joins")) is None:
            return recording, None
        model = await asyncio.to_thread(self.versions.get, joins)
        return await together.join(self.analyses, [model.recording_id, recording.id], row.participant), model.id

    async def _first_version(
        self, row: Test, recording: Recording, parent: str | None, follow: Callable[[Job], None], how: dict[str, Any]
    ) -> Model:
        """Fit the first version of a test's recording; the test names it at once, whatever comes after it."""
        if row.model_id is not None:
            return await asyncio.to_thread(self.versions.get, row.model_id)
        options = await asyncio.to_thread(self.kinds[row.kind].fit_options, row)
        fit = await self.analyses.run("fit", follow, data=recording.path, **how, **options)
        by = f"test {row.id}"
        model = await asyncio.to_thread(self.versions.add, fit["json"], row.participant, recording.id, by, parent)
        await asyncio.to_thread(self.update, row.id, model_id=model.id)
        return model

    async def close(self) -> None:
        """End what goes on in the background."""
        await self._tasks.close()
        await asyncio.to_thread(self._reader.shutdown)

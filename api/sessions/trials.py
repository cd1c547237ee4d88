"""After each trial of a controller: the muscle is followed in a worker of its own, and the result is kept.

A trial's test is over before it is followed: nothing that is played waits for it. Trials are followed one after the
other, in the order in which they ended.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.jobs.pool import Pool
from stimrig.api.jobs.tasks import Tasks
from stimrig.api.models.places import differ, place_of
from stimrig.api.models.tracked import TrackedVersions, Trial
from stimrig.api.sessions.kinds import Kind
from stimrig.api.sessions.requests import TestIn
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store.tables import Approval, Recording, Test, Tracked

log = logging.getLogger("stimrig.tracking")
SEQUENCE = "sequence"
"""A test of this kind is a controller's trial."""
PATIENCE_S = 2.0
"""So long a request for a tracked model waits for a trial that has just ended."""
MOST_BETWEEN = 20
"""So many recordings between two trials that were followed are passed through the effects."""
ELSEWHERE = "It was played at another side, muscle or current than the approved model's test."


class Trials(Kind):
    """Follows what controllers play; nothing is identified from it. `tracker`: a worker that does nothing else."""

    names, fitted = (SEQUENCE,), False

    def __init__(self, rig: RigClient, tracked: TrackedVersions, tracker: Pool) -> None:
        super().__init__(rig)
        self.store, self.clock, self.tracked, self.tracker = tracked.store, tracked.clock, tracked, tracker
        self._turn = asyncio.Lock()
        self._ending = 0
        self._settled = asyncio.Event()
        self._settled.set()
        self._tasks = Tasks(log)

    def stored_fields(self, body: TestIn, pulses: int) -> dict[str, Any]:
        """Return its approval and the reference torque, one value for each pulse. Raises ApiError (422): it is not."""
        reference = body.reference_torque_nm
        if reference is not None and len(reference) != pulses:
            detail = f"reference_torque_nm: {len(reference)} values, but the whole test has {pulses} pulses."
            raise ApiError(422, "invalid-input", "The reference does not fit the test", detail)
        approval = self.tracked.allowing(body.participant)
        return {"approval_id": approval.id if approval else None, "reference_torque_nm": reference}

    def warm(self, participant: str) -> None:
        """Have the worker load what a trial of this participant needs, so that none waits for it."""
        self._tasks.begin(self._warm(participant))

    async def _warm(self, participant: str) -> None:
        approval = await asyncio.to_thread(self.tracked.allowing, participant)
        if approval is None:
            return
        try:
            _version, text = await asyncio.to_thread(self.tracked.find, approval.model_id)
            await asyncio.to_thread(self.tracked.earlier, approval)
            await self.tracker.submit("track_warm", model_json=text).result
        except ApiError as error:
            log.warning("the worker of trials could not be warmed: %s", error)

    @contextmanager
    def ending(self) -> Iterator[None]:
        """Mark the end of a test: a fetch of a tracked model waits meanwhile, since the test may be a trial."""
        self._ending += 1
        self._settled.clear()
        try:
            yield
        finally:
            self._ending -= 1
            if not self._ending:
                self._settled.set()

    async def settled(self) -> None:
        """Wait for trials that have ended and are being followed, for a little while."""
        try:
            async with asyncio.timeout(PATIENCE_S):
                await self._settled.wait()
        except TimeoutError:
            log.warning("a trial is still being followed; the version before it is served")

    async def follow(self, test_id: str, last_sample_unix_s: float | None = None) -> Tracked | None:
        """Follow a trial that has ended and return its row; None where it is stored already."""
        with self.ending():
            async with self._turn:
                trial = await asyncio.to_thread(self.tracked.open_trial, test_id)
                if trial is None:
                    return None
                result = await self._examine(trial)
                row = await asyncio.to_thread(self.tracked.add_trial, trial, result, last_sample_unix_s)
        if row is not None:
            log.info("trial %d: %s %s", row.number, row.outcome, row.reason, extra={"test_id": test_id})
        return row

    async def _examine(self, trial: Trial) -> dict[str, Any]:
        """Return the worker's result, or the reason for none: no trial is lost."""
        recording: Recording | None = await asyncio.to_thread(self.store.get, Recording, trial.test.recording_id or "")
        if recording is None:
            return {"reason": "It has no recording."}
        if await asyncio.to_thread(self.tracked.elsewhere, trial.approval, [place_of(trial.test)]):
            return {"reason": ELSEWHERE}
        try:
            arguments = await asyncio.to_thread(self.tracked.arguments, trial)
            between = await asyncio.to_thread(self._between, trial, recording)
            return await self.tracker.submit("track", data=recording.path, between=between, **arguments).result
        except ApiError as error:
            if error.code == "worker-died":
                self.warm(trial.test.participant)
            return {"reason": error.detail or error.title}

    def _between(self, trial: Trial, recording: Recording) -> list[str]:
        """List the recordings since the last known state, oldest first; empty for a model without effects.

        Where nothing was followed yet, it begins with the approved model's test.
        """
        since_id = (trial.last and trial.last.recording_id) or trial.model.recording_id
        since: Recording | None = self.store.get(Recording, since_id)
        if since is None or not trial.model.effects:
            return []
        conditions = (
            Recording.participant == recording.participant, Recording.test_id.is_not(None),
            Recording.created_utc > since.created_utc, Recording.created_utc < recording.created_utc,
        )  # fmt: skip
        newest_first = Recording.created_utc.desc()
        recordings = self.store.all(Recording, *conditions, order=newest_first, limit=MOST_BETWEEN)[::-1]
        tests = {row.id: row for row in self.store.all(Test, Test.id.in_([row.test_id for row in recordings]))}
        place = place_of(trial.test)
        here = [row for row in recordings if row.test_id in tests and not differ(place_of(tests[row.test_id]), place)]
        return [row.path for row in (here if trial.last else [since, *here])]

    def resume(self) -> None:
        """Follow the trials that a restart left open, and warm the worker where a model may be tracked."""
        self._tasks.begin(self._resume())

    async def _resume(self) -> None:
        for approval, open_trials in await asyncio.to_thread(self._open_trials):
            try:
                for test_id in open_trials:
                    await self.follow(test_id)
            except ApiError as error:  # a damaged model must not block the other participants' trials
                log.warning("trials with %s are not followed: %s", approval.model_id, error)
            await self._warm(approval.participant)

    def _open_trials(self) -> list[tuple[Approval, list[str]]]:
        """List the valid approvals that allow tracking, each with its trials of today, oldest first."""
        codes = self.store.all(Approval.participant, Approval.approved, Approval.expires_utc > self.clock.utc())
        today = Test.kind == SEQUENCE, Test.state == "completed", Test.requested_utc >= self.clock.start_of_day_utc()
        played = self.store.all(Test, *today, order=Test.requested_utc)
        approvals = [approval for code in sorted(set(codes)) if (approval := self.tracked.allowing(code))]
        return [
            (approval, [test.id for test in played if test.plan.get("approval_id") == approval.id])
            for approval in approvals
        ]

    async def close(self) -> None:
        """Release all resources; open trials are followed at the next start."""
        await self._tasks.close()
        await self.tracker.close()

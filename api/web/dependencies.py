"""The service's parts, made once and handed to the routes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, Request, Security
from sqlalchemy.exc import SQLAlchemyError
from starlette.requests import HTTPConnection

from stimrig.api import owner_only
from stimrig.api.clock import Clock, set_zone
from stimrig.api.models.analyses import Analyses
from stimrig.api.models.registry import Versions
from stimrig.api.models.tracked import TrackedVersions
from stimrig.api.models.trend import Trend
from stimrig.api.outbox.feed import Feed
from stimrig.api.outbox.receipts import note_hourly
from stimrig.api.people.accounts import People
from stimrig.api.people.auth import Auth, Principal, Scope
from stimrig.api.people.idle_lock import FLUSH_S, IdleLock
from stimrig.api.people.pace import Guesses
from stimrig.api.sessions.lifecycle import Follower
from stimrig.api.sessions.notes import Notes
from stimrig.api.sessions.questions import Questions
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.sessions.runner import Runner
from stimrig.api.sessions.stops import StopLog, StopRights
from stimrig.api.sessions.trials import Trials
from stimrig.api.settings import Settings
from stimrig.api.store import Store, holds, uploads
from stimrig.api.store.holds import Holds, ServiceLock
from stimrig.api.store.tables import Model, Recording
from stimrig.api.web.guards import anyone_even_locked, anyone_signed_in, require
from stimrig.api.web.openapi import problem
from stimrig.api.web.stop_guard import Press, anyone_who_may_stop
from stimrig.api.workers.jobs import Jobs
from stimrig.api.workers.pool import WORKER, Adviser, Pool
from stimrig.api.workers.process import Places

log = logging.getLogger("stimrig.api")


@dataclass
class Context:
    """Everything a route may need."""

    settings: Settings
    clock: Clock
    store: Store
    auth: Auth
    people: People
    stop_rights: StopRights
    rig: RigClient
    pool: Pool
    versions: Versions
    tracked: TrackedVersions
    runner: Runner
    analyses: Analyses
    trend: Trend
    jobs: Jobs
    lock: ServiceLock
    questions: Questions
    notes: Notes
    holds: Holds
    drawn_token: str | None = None
    stops: StopLog = field(default_factory=StopLog)
    started_s: float = field(default_factory=time.monotonic)
    flushing: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Connect, warm the workers, take up what a restart left open."""
        await asyncio.to_thread(uploads.settle, self.settings.recordings_dir, self.store)
        self.rig.start()
        self.pool.warm()
        for _ in range(20):  # a rig that is there answers within milliseconds
            if self.rig.connected or self.rig.path is None:
                break
            await asyncio.sleep(0.05)
        await self.runner.resume()
        self.flushing = asyncio.create_task(self._flush())

    async def _flush(self) -> None:
        while True:
            await asyncio.sleep(FLUSH_S)
            try:
                await asyncio.to_thread(self.auth.idle.flush)
                if self.settings.heads_file is not None:
                    await asyncio.to_thread(note_hourly, self.store, self.clock, self.settings.heads_file)
            except (SQLAlchemyError, OSError):  # the next time has it all
                log.exception("people's last actions, or the audit trail's head, could not be written down")

    async def close(self) -> None:
        """Let everything go."""
        if self.flushing is not None:
            self.flushing.cancel()
            with contextlib.suppress(SQLAlchemyError):
                await asyncio.to_thread(self.auth.idle.flush)
        await self.runner.close()
        await self.jobs.close()
        await self.pool.close()
        await self.rig.close()
        self.holds.close()
        self.people.close()
        self.auth.close()
        self.store.close()
        self.lock.release()


def build(
    settings: Settings, clock: Clock | None = None, worker: tuple[str, ...] = WORKER, lock: ServiceLock | None = None
) -> Context:
    """Make the parts; `lock` is held already, or taken now.

    Raises
    ------
    ApiError
        The database cannot be opened.
    HeldError
        Another service holds the data folder or the database.
    """
    lock = lock or ServiceLock(settings)
    try:
        return _build(settings, clock or Clock(), worker, lock)
    except BaseException:
        lock.release()
        raise


def _build(settings: Settings, clock: Clock, worker: tuple[str, ...], lock: ServiceLock) -> Context:
    make_folders(settings)
    if settings.time_zone:
        set_zone(settings.time_zone)
    store = Store(settings.database)
    if settings.centre_url is not None:
        Feed(store, clock)
    guesses = Guesses(clock)
    idle = IdleLock(store, clock, settings.idle_lock_min)
    auth = Auth(store, clock, guesses, idle, settings.session_hours)
    configured = settings.admin_token.get_secret_value() if settings.admin_token else None
    drawn = auth.first_administrator(configured)
    rig = RigClient(settings.rig_socket, clock)
    pool = Pool(settings.workers, worker, places(settings, store))
    versions = Versions(store, clock)
    analyses = Analyses(store, clock, pool, versions, settings)
    adviser = Adviser(worker, places(settings, store))  # its own: a folder that the pool learns ends no test
    tracked = TrackedVersions(store, clock, versions)
    trials = Trials(rig, store, clock, tracked, Adviser(worker, places(settings, store)))
    held = holds.of(store)
    follower = Follower(store, held, settings.rig)
    runner = Runner(store, clock, rig, pool, versions, analyses, adviser, trials, settings.recordings_dir, follower)
    jobs = Jobs(pool)
    people = People(store, clock, auth, guesses)
    rights = StopRights(holds.shared_secret(store, "stop-right", settings.data_dir / "stop-right.key"), clock)
    questions = Questions(clock)
    return Context(
        settings, clock, store, auth, people, rights, rig, pool, versions, tracked, runner, analyses,
        Trend(store, clock, pool), jobs, lock, questions, Notes(store, clock), held, drawn
    )  # fmt: skip


def make_folders(settings: Settings) -> None:
    """Folders for their owner only; the rig may share that of recordings with a group."""
    owner_only.close(owner_only.folder(settings.recordings_dir), 0o770)
    owner_only.close(owner_only.folder(settings.recordings_dir / uploads.PARTS), 0o700)
    owner_only.close(settings.logs_dir, 0o700)
    shutil.rmtree(settings.exports_dir, ignore_errors=True)
    owner_only.folder(settings.exports_dir)


def places(settings: Settings, store: Store) -> Places:
    """The folders that workers may reach: those of recordings, known ones of a rig that runs by itself included."""
    reads = {settings.recordings_dir, *(Path(path).parent for path in store.all(Recording.path))}
    reads |= {settings.effects_dir} if settings.effects_dir else set()
    return Places(reads, [settings.exports_dir])


def of(connection: HTTPConnection) -> Context:
    """The application's context."""
    return connection.app.state.context


async def from_request(request: Request) -> Context:
    """The application's context, as a dependency; not in a worker thread: a stop waits for none of them."""
    return of(request)


Ctx = Annotated[Context, Depends(from_request)]
Anyone = Annotated[Principal, Depends(anyone_signed_in)]
EvenLocked = Annotated[Principal, Depends(anyone_even_locked)]
MayStop = Annotated[Press, Depends(anyone_who_may_stop)]
LiveReader = Annotated[Principal, Security(require(Scope.READ_LIVE), scopes=[Scope.READ_LIVE])]
Tester = Annotated[Principal, Security(require(Scope.RUN_TEST), scopes=[Scope.RUN_TEST])]
Rearmer = Annotated[Principal, Security(require(Scope.REARM), scopes=[Scope.REARM])]
Approver = Annotated[Principal, Security(require(Scope.APPROVE_MODEL), scopes=[Scope.APPROVE_MODEL])]
ModelReader = Annotated[Principal, Security(require(Scope.READ_MODEL), scopes=[Scope.READ_MODEL])]
Administrator = Annotated[Principal, Security(require(Scope.ADMINISTER), scopes=[Scope.ADMINISTER])]


async def _version(context: Ctx, model_id: str) -> Model:
    return await asyncio.to_thread(context.versions.get, model_id)


Version = Annotated[Model, Depends(_version)]
"""The model version of the path's `model_id`; after who asks for it, so that only they hear that there is none."""

PROBLEM: dict[int | str, dict[str, Any]] = {
    code: problem(text)
    for code, text in {
        401: "not signed in", 403: "the scope or the form's token is missing", 404: "not there",
        409: "in conflict with what is", 422: "does not hold: `errors` names the fields",
        503: "the rig cannot be reached, or too much at once",
    }.items()
}  # fmt: skip
"""Problems of every route that asks who comes."""

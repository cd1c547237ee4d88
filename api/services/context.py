"""The parts of the service, made once; services and routes get them as one context."""

from __future__ import annotations

import asyncio
import functools
import shutil
import time
from collections.abc import Callable, Coroutine
from typing import Any, Concatenate, ParamSpec, TypeVar

from stimrig.api import owner_only
from stimrig.api.clock import Clock, set_zone
from stimrig.api.jobs.pool import Pool
from stimrig.api.jobs.registry import Jobs
from stimrig.api.jobs.worker import Worker
from stimrig.api.models.analyses import Analyses
from stimrig.api.models.registry import Versions
from stimrig.api.models.tracked import TrackedVersions
from stimrig.api.people.accounts import People
from stimrig.api.people.auth import Auth
from stimrig.api.people.pace import Guesses
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.sessions.runner import Runner
from stimrig.api.sessions.stops import StopRights, Stops
from stimrig.api.sessions.trials import Trials
from stimrig.api.settings import Settings
from stimrig.api.store import Store, uploads
from stimrig.api.store.service_lock import KEEP_S, ServiceLock

P = ParamSpec("P")
T = TypeVar("T")


class Context:
    """Everything a route of the service may need.

    `worker`: makes a worker process. `lock`: of the data folder and the database, which is held.
    """

    def __init__(self, settings: Settings, clock: Clock, worker: Callable[..., Worker], lock: ServiceLock) -> None:
        make_folders(settings)
        if settings.time_zone:
            set_zone(settings.time_zone)
        self.settings, self.clock, self.lock, self.started_s = settings, clock, lock, time.monotonic()
        store = self.store = Store(settings.database)
        guesses = self.guesses = Guesses(clock)
        self.auth = Auth(store, clock, guesses, settings.idle_min, settings.session_hours)
        admin_token = settings.admin_token.get_secret_value() if settings.admin_token else None
        self.drawn_token = self.auth.first_administrator(admin_token)
        self.people = People(store, clock, self.auth, guesses)
        self.versions = Versions(store, clock)
        self.rig = RigClient(settings.rig_socket, clock)
        self.pool = Pool(settings.workers, worker)
        self.analyses = Analyses(store, clock, self.pool, self.versions, settings)
        self.tracked = TrackedVersions(store, clock, self.versions)
        self.limits_lock = asyncio.Lock()
        """Held by a change of limits, and by a calibration or test while it is sent by them: once a change is answered,
        nothing begins with the limits of before."""
        # processes of their own: they remember a test or a trial, and nothing else keeps them busy
        adviser, tracker = Pool(1, worker), Pool(1, worker)
        self.stops, self.stop_rights = Stops(store, clock, self.rig), StopRights(store.secret("stop-right"), clock)
        trials = Trials(self.rig, self.tracked, tracker)
        self.runner = Runner(self.analyses, self.rig, self.stops, trials, adviser, self.limits_lock)
        self.jobs = Jobs(self.pool)
        self._renewing: asyncio.Task[None] | None = None

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
        self._renewing = asyncio.create_task(self._renew())

    async def _renew(self) -> None:
        while True:
            await asyncio.sleep(KEEP_S)
            await asyncio.to_thread(self.lock.renew)

    async def close(self) -> None:
        """Release all resources."""
        for part in (self.runner, self.stops, self.jobs, self.pool, self.rig):
            await part.close()
        if self._renewing is not None:
            self._renewing.cancel()
        self.auth.close()
        self.store.close()
        self.lock.release()


def build(settings: Settings, worker: Callable[..., Worker] = Worker, lock: ServiceLock | None = None) -> Context:
    """Make the parts; `lock` is held already, or taken now.

    Raises ApiError: the database cannot be opened. HeldError: another service holds the data folder or the database.
    """
    lock = lock or ServiceLock(settings)
    try:
        return Context(settings, Clock(), worker, lock)
    except BaseException:
        lock.release()
        raise


def make_folders(settings: Settings) -> None:
    """Make folders for their owner only; the rig may share that of recordings with a group."""
    owner_only.close(owner_only.folder(settings.recordings_dir), 0o770)
    owner_only.close(owner_only.folder(settings.recordings_dir / uploads.PARTS), 0o700)
    owner_only.close(settings.logs_dir, 0o700)
    shutil.rmtree(settings.exports_dir, ignore_errors=True)
    owner_only.folder(settings.exports_dir)


def under_limits_lock(
    change: Callable[Concatenate[Context, P], T],
) -> Callable[Concatenate[Context, P], Coroutine[Any, Any, T]]:
    """Do a change in a thread, under the lock of the limits."""

    @functools.wraps(change)
    async def changed(context: Context, /, *args: P.args, **kwargs: P.kwargs) -> T:
        async with context.limits_lock:
            return await asyncio.to_thread(change, context, *args, **kwargs)

    return changed

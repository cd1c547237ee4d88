"""The service's parts, made once and handed to the routes."""

from __future__ import annotations

import asyncio
import shutil
import time
from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import Depends, Request
from starlette.requests import HTTPConnection

from api.analyses import Analyses
from api.auth import Auth, Principal, Scope, anyone_signed_in, anyone_who_may_stop, require
from api.clock import Clock
from api.fitting import WORKER, Fitting
from api.people import People
from api.rig_client import RigClient
from api.settings import Settings
from api.store import Store
from api.tasks import Tasks
from api.trials import Trials
from api.versions import Versions


@dataclass
class Context:
    """Everything a route may need."""

    settings: Settings
    clock: Clock
    store: Store
    auth: Auth
    people: People
    rig: RigClient
    fitting: Fitting
    versions: Versions
    trials: Trials
    analyses: Analyses
    tasks: Tasks
    drawn_token: str | None = None
    started_s: float = field(default_factory=time.monotonic)

    async def open(self) -> None:
        """Connect, warm the workers, take up what a restart left open."""
        self.rig.start()
        self.fitting.warm()
        for _ in range(20):  # a rig that is there answers within milliseconds
            if self.rig.connected or self.rig.path is None:
                break
            await asyncio.sleep(0.05)
        await self.trials.resume()

    async def close(self) -> None:
        """Let everything go."""
        await self.trials.close()
        await self.tasks.close()
        await self.fitting.close()
        await self.rig.close()
        self.store.close()


def build(settings: Settings, clock: Clock | None = None, worker: tuple[str, ...] = WORKER) -> Context:
    """Make the parts.

    Raises
    ------
    ApiError
        The database cannot be opened.
    """
    clock = clock or Clock()
    settings.recordings_dir.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(settings.exports_dir, ignore_errors=True)
    settings.exports_dir.mkdir()
    store = Store(settings.database)
    auth = Auth(store, clock, settings.session_hours)
    configured = settings.admin_token.get_secret_value() if settings.admin_token else None
    drawn = auth.first_administrator(configured)
    rig = RigClient(settings.rig_socket, clock)
    fitting = Fitting(settings.workers, worker)
    versions = Versions(store, clock)
    analyses = Analyses(store, clock, fitting, versions)
    trials = Trials(store, clock, rig, fitting, versions, analyses, settings.recordings_dir)
    tasks = Tasks(fitting)
    people = People(store, clock, auth)
    return Context(settings, clock, store, auth, people, rig, fitting, versions, trials, analyses, tasks, drawn)


def of(connection: HTTPConnection) -> Context:
    """The application's context."""
    return connection.app.state.context


def from_request(request: Request) -> Context:
    """The application's context, as a dependency."""
    return of(request)


Ctx = Annotated[Context, Depends(from_request)]
Anyone = Annotated[Principal, Depends(anyone_signed_in)]
MayStop = Annotated[Principal, Depends(anyone_who_may_stop)]
LiveReader = Annotated[Principal, Depends(require(Scope.READ_LIVE))]
Tester = Annotated[Principal, Depends(require(Scope.RUN_TEST))]
Approver = Annotated[Principal, Depends(require(Scope.APPROVE_MODEL))]
ModelReader = Annotated[Principal, Depends(require(Scope.READ_MODEL))]
Administrator = Annotated[Principal, Depends(require(Scope.ADMINISTER))]

PROBLEM: dict[int | str, dict[str, Any]] = {
    code: {"description": text, "content": {"application/problem+json": {}}}
    for code, text in {
        401: "not signed in", 403: "not allowed", 404: "not there", 409: "in conflict with what is",
        422: "does not hold", 503: "the rig cannot be reached",
    }.items()
}  # fmt: skip

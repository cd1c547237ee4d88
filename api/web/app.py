"""The service: its parts, its routes, its page."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from functools import cache
from types import ModuleType
from typing import Any

from fastapi import APIRouter, FastAPI
from starlette.routing import BaseRoute
from starlette.types import ASGIApp

from stimrig.api.jobs.worker import Worker
from stimrig.api.services.context import build
from stimrig.api.settings import Settings
from stimrig.api.store.service_lock import ServiceLock
from stimrig.api.version import software_version
from stimrig.api.web import openapi, pages, problems, routes
from stimrig.api.web.middleware import BodyLimit, Headers, LookAgain, RequestId, StrictBody


class Service(FastAPI):
    """The application. Its headers are outermost: an unexpected error's answer has them, too."""

    def build_middleware_stack(self) -> ASGIApp:
        """Starlette's, within the headers."""
        return Headers(super().build_middleware_stack())


def create_app(
    settings: Settings | None = None, *, worker: Callable[..., Worker] = Worker, lock: ServiceLock | None = None
) -> FastAPI:
    """The application.

    Parameters
    ----------
    settings : Settings, optional
        Default: from the environment.
    worker : callable
        Makes a worker process.
    lock : ServiceLock, optional
        Held already; default: taken now.

    Raises
    ------
    ApiError
        The database cannot be opened.
    HeldError
        Another service holds the data folder or the database.
    """
    context = build(settings or Settings(), worker, lock)
    app = Service(
        title="stimrig",
        summary="Pre-session tests, models of stimulated muscle, and the approved one for the controller.",
        description=openapi.DESCRIPTION,
        version=software_version(),
        lifespan=_lifespan(context),
        docs_url=None,
        redoc_url=None,
        openapi_url="/openapi.json",
        routes=list(_routes()),
    )
    app.state.context = context
    app.add_middleware(LookAgain, context=context)
    app.add_middleware(StrictBody)
    app.add_middleware(BodyLimit, context=context)
    app.add_middleware(RequestId)  # the last one added stands outside
    problems.install(app)
    openapi.describe(app)
    return app


@cache
def _routes() -> Sequence[BaseRoute]:
    """All routes, made once a process: FastAPI examines every endpoint anew for each application it is included in.

    A client that is made of the document has a function of each endpoint's name.
    """
    whole = APIRouter(generate_unique_id_function=lambda route: route.name)
    for router in routers(routes, pages):
        whole.include_router(router)
    return whole.routes


def _lifespan(context: Any):
    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        await context.open()
        try:
            yield
        finally:
            await context.close()

    return lifespan


def routers(*packages: ModuleType) -> list[APIRouter]:
    """The routers of all files in these packages: a new file is a new subject."""
    names = [
        f"{package.__name__}.{info.name}"
        for package in packages
        for info in sorted(pkgutil.iter_modules(package.__path__))
    ]
    values = [value for name in names for value in vars(importlib.import_module(name)).values()]
    return [value for value in values if isinstance(value, APIRouter)]

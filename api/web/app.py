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
from stimrig.api.web.middleware import Boundary


class Service(FastAPI):
    """The application."""

    def build_middleware_stack(self) -> ASGIApp:
        """Starlette's within the boundary: an unexpected error's answer has its headers, too."""
        return Boundary(super().build_middleware_stack(), self.state.context)

    def openapi(self) -> dict[str, Any]:
        """FastAPI's document, made complete once."""
        if self.openapi_schema is None:
            openapi.complete(super().openapi(), self.state.context.auth.cookie_name)
        return super().openapi()


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

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        await context.open()
        try:
            yield
        finally:
            await context.close()

    app = Service(
        title="stimrig",
        summary="Pre-session tests, models of stimulated muscle, and the approved one for the controller.",
        description=openapi.DESCRIPTION,
        version=software_version(),
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        routes=list(_routes()),
        exception_handlers=dict.fromkeys(problems.PROBLEMS, problems.respond),
    )
    app.state.context = context
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


def routers(*packages: ModuleType) -> list[APIRouter]:
    """The routers of all files in these packages: a new file is a new subject."""
    files = [info for package in packages for info in pkgutil.iter_modules(package.__path__, f"{package.__name__}.")]
    values = [value for info in files for value in vars(importlib.import_module(info.name)).values()]
    return [value for value in values if isinstance(value, APIRouter)]

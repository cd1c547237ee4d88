"""The centre's application: an application of its own, without rig, runner, workers, tests and stop button."""

from __future__ import annotations

from fastapi import FastAPI
from fastapi.routing import APIRoute
from starlette.types import Receive, Scope, Send
from stimrig.api.centre.context import CentreSettings, build
from stimrig.api.centre.ingest import MOST_BATCH_BYTES
from stimrig.api.centre.spool import MOST_PIECE_BYTES

from stimrig.api.centre import pages, rig_routes, routes
from stimrig.api.clock import Clock
from stimrig.api.web import openapi, problems
from stimrig.api.web import pages as web_pages
from stimrig.api.web import routes as web_routes
from stimrig.api.web.app import Service, routers
from stimrig.api.web.middleware import BODY_BYTES, BODY_S, BodyLimit, StrictBody

DESCRIPTION = """
Rigs push with their own keys to `/v1/rig/…`; everything else is for people and programs, who only read: programs send
`Authorization: Bearer <token>`, browsers have a session's cookie. Every error is `application/problem+json` (RFC 9457).
"""
RIG_SIDE = "/v1/rig/"
PIECE_S = 300.0
ROUTERS = (routes.operation, routes.v1, rig_routes.router, pages.router)
SHARED = (
    "/sign-in", "/sign-out", "/locked", "/unlock", "/lock", "/rig/acted",
    "/colours", "/static/{name}", "/docs", "/administration", "/administration/users",
    "/administration/users/{name}/password",
    "/administration/users/{name}/remove", "/administration/keys", "/administration/tokens/{token_id}/revoke",
    "/administration/audit.jsonl", "/v1/users", "/v1/users/{name}/password",
    "/v1/users/{name}", "/v1/sessions", "/v1/sessions/lock", "/v1/sessions/unlock", "/v1/sessions/current",
    "/v1/tokens", "/v1/tokens/{token_id}", "/v1/audit",
)  # fmt: skip
"""Addresses of a rig's service that the centre has, too: signing in, people, tokens, audit trail, what pages need."""


class CentreBodyLimit(BodyLimit):
    """Batches of items and pieces of files may be longer than a person's requests."""

    def bounds(self, path: str) -> tuple[int, float]:
        """Most bytes that a route takes, and for how long it waits for them, s."""
        if path.startswith(f"{RIG_SIDE}files/"):
            return MOST_PIECE_BYTES, PIECE_S
        if path.rstrip("/") == f"{RIG_SIDE}items":
            return MOST_BATCH_BYTES, PIECE_S
        return BODY_BYTES, BODY_S


class CentreStrictBody(StrictBody):
    """What rigs send is read strictly by its route: in a thread, and only after the key."""

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        await (self.app if scope["path"].startswith(RIG_SIDE) else super().serve)(scope, receive, send)


def create_app(settings: CentreSettings | None = None, clock: Clock | None = None) -> FastAPI:
    """The application.

    Raises ApiError: the database cannot be opened. SettingsError: the bucket is not there, or a package is missing.
    """
    context = build(settings or CentreSettings(), clock)
    app = Service(context, title="stimrig centre", summary="What rigs have pushed.", description=DESCRIPTION)
    app.state.face = pages.FACE
    app.add_middleware(CentreStrictBody)
    app.add_middleware(CentreBodyLimit, context=context)  # the last one added stands outside
    problems.install(app)
    for router in ROUTERS:
        app.include_router(router)
    app.router.routes.extend(shared())
    openapi.describe(app)
    return app


def shared() -> list[APIRoute]:
    """The routes of a rig's service that the centre has, too."""
    there = [route for router in routers(web_routes, web_pages) for route in router.routes]
    return [route for route in there if isinstance(route, APIRoute) and route.path in SHARED]

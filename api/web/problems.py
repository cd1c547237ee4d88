"""Every error that a client can meet, as RFC 9457 ``application/problem+json``: the one mapping place."""

from __future__ import annotations

import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from sqlalchemy.exc import DataError, InterfaceError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from stimrig.api.errors import ApiError, invalid, not_answering
from stimrig.api.web.middleware import wants_html
from stimrig.api.web.pages.render import look, problem_page

log = logging.getLogger("stimrig.api")


def from_validation(error: RequestValidationError) -> ApiError:
    """Fields that do not hold, each named with what would do."""
    found = []
    for item in error.errors():
        if item["type"] == "json_invalid":
            where = item["loc"][-1]
            return invalid(f"The body is no JSON from character {where} on. Send one whole JSON object in UTF-8.")
        place = ".".join(str(part) for part in item.get("loc", ()) if part != "body") or "body"
        found.append({"field": place, "detail": str(item.get("msg", "")), "got": _short(item.get("input"))})
    names = "; ".join(f"{item['field']}: {item['detail']}" for item in found)
    return invalid(names, errors=found)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _from_http(error: HTTPException) -> ApiError:
    phrase = HTTPStatus(error.status_code).phrase
    problem = ApiError(error.status_code, phrase.lower().replace(" ", "-"), phrase, _http_detail(error))
    problem.headers = dict(error.headers or {})
    return problem


def _http_detail(error: HTTPException) -> str:
    if error.status_code == 404:
        return "There is nothing at this address. /openapi.json lists what there is."
    if error.status_code == 405:
        return "The address is right, the method is not. /openapi.json lists what there is."
    return str(error.detail)


async def respond(request: Request, problem: ApiError) -> Response:
    """The problem as JSON, or as a page where a browser's form asked."""
    if wants_html(request):
        await look(request)
        return problem_page(request, problem)
    return JSONResponse(
        problem.body(str(request.url.path)),
        status_code=problem.status,
        media_type="application/problem+json",
        headers=problem.headers,
    )


def template_of(request: Request) -> str:
    """The route's address as logs have it: without the participant that it may name."""
    return getattr(request.scope.get("route"), "path", "?")


def install(app: FastAPI) -> None:
    """Hang the mapping into the application."""

    @app.exception_handler(ApiError)
    async def known(request: Request, error: ApiError) -> Response:
        return await respond(request, error)

    @app.exception_handler(RequestValidationError)
    async def does_not_hold(request: Request, error: RequestValidationError) -> Response:
        return await respond(request, from_validation(error))

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> Response:
        return await respond(request, _from_http(error))

    @app.exception_handler(ClientDisconnect)
    async def left(request: Request, error: ClientDisconnect) -> Response:  # noqa: ARG001
        log.info("who asked for %s %s left before the whole of it was here", request.method, template_of(request))
        return Response(status_code=400)

    @app.exception_handler(OperationalError)
    @app.exception_handler(InterfaceError)
    @app.exception_handler(PoolTimeout)
    async def no_database(request: Request, error: SQLAlchemyError) -> Response:
        log.error("the database, in %s %s: %s", request.method, template_of(request), error)
        return await respond(request, not_answering())

    @app.exception_handler(DataError)
    async def not_to_be_kept(request: Request, error: DataError) -> Response:
        detail = f"The database takes no such value: {str(error.orig).splitlines()[0]}"
        return await respond(request, invalid(detail))

    @app.exception_handler(Exception)
    async def unexpected(request: Request, error: Exception) -> Response:
        log.exception("unexpected error in %s %s", request.method, template_of(request), exc_info=error)
        detail = "Nothing was lost. The service's log (logs/api.log in the data folder) says more."
        return await respond(request, ApiError(500, "internal", "Something unexpected went wrong here", detail))
